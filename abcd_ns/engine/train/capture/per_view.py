"""Numbers that belong to a view each: how a run keeps them in its state, bit for bit."""

import base64
from collections.abc import Mapping

import torch
from torch import Tensor


def to_json(tensors: Mapping[str, Tensor]) -> dict[str, str]:
    """Tensors at rest, by name; shapes are whoever's who restores them."""
    return {
        name: base64.b64encode(value.cpu().contiguous().numpy().tobytes()).decode()
        for name, value in tensors.items()
    }


def restore(tensors: Mapping[str, Tensor], data: Mapping[str, str]) -> None:
    """Copy into tensors, by name, what `to_json` made of others of their shapes and dtypes."""
    for name, value in tensors.items():
        found = torch.frombuffer(bytearray(base64.b64decode(data[name])), dtype=value.dtype)
        value.copy_(found.view_as(value))
