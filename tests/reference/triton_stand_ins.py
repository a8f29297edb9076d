"""What the package's Triton kernels compute, in torch: their oracles, and what a simulated device runs."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from torch import Tensor

from abcd_ns.engine.kernels.photometric import photometric_sums
from abcd_ns.engine.layers.compositing import composite, sandwich
from abcd_ns.engine.render.base import Shown
from abcd_ns.engine.render.cuda import fused
from abcd_ns.engine.types import Layer
from tests.reference import simulated_device


def photometric(rendered: Tensor, photo: Tensor, by_pixel: float, by_window: float) -> tuple[Tensor, Tensor]:
    """The loss, and its gradient by `rendered`."""
    sums, gradient = photometric_sums(rendered, photo, (by_pixel, by_window))
    return by_pixel * sums[0] + by_window * sums[1], gradient


def between(
    features: Tensor, alphas: Tensor, shown: Sequence[Shown], gradients: Sequence[Tensor] | None = None
) -> list[Tensor]:
    """Pictures, or the gradients by features and alphas of what they and the weights of pixels add up to."""
    features, alphas = (value.detach().requires_grad_() for value in (features, alphas))
    pictures, weights = [], []
    with torch.enable_grad():
        for camera, (part, frame) in enumerate(shown):
            drawn, through = features[camera][part], 1 - alphas[camera][part][..., 0]
            own = Layer(drawn[..., :3], through)
            if frame.front is None:
                picture = composite(own, frame.background)
            else:
                picture = sandwich(frame.front, own, frame.back, frame.background)
            pictures.append(picture.clamp(0, 1))
            weights.append(drawn[..., 3])
        if gradients is None:
            return [picture.detach() for picture in pictures]
        counts = [
            (torch.ones_like(weight) if frame.front is None else frame.front.transmittance.float())
            * frame.counts
            for (_, frame), weight in zip(shown, weights, strict=True)
        ]
        return list(torch.autograd.grad([*pictures, *weights], [features, alphas], [*gradients, *counts]))


def shade(colors: Tensor, depths: Tensor | None) -> tuple[Tensor, Tensor]:
    """What is composited, and which colours would be less than 0."""
    lighter = colors + 0.5
    last = torch.zeros_like(colors[..., 0]) if depths is None else depths
    return torch.cat((lighter.clamp_min(0.0), last[..., None]), dim=-1), lighter < 0


def skips(count: Tensor, norms: Sequence[Tensor]) -> Tensor:
    """1 where any norm is no number, else 0; counts the others."""
    found = 1 - torch.stack(list(norms)).isfinite().all().float()
    count += 1 - found
    return found


def windowed(
    near, far, isect_ids, flatten_ids, always: int, bits: int, tiles: int, last_key: int
) -> tuple[Tensor, Tensor]:
    """Keys and owners: those that are kept, and as many others as there were."""
    place, z = isect_ids >> 32, (isect_ids & 0xFFFFFFFF).int().view(torch.float32)
    tile = (place >> bits) * tiles + place % (1 << bits)
    keep = (z >= near[tile]) & (z < far[tile]) | (flatten_ids < always)
    keys, owners = torch.full_like(isect_ids, last_key), torch.zeros_like(flatten_ids)
    count = int(keep.sum())
    keys[:count], owners[:count] = isect_ids[keep], flatten_ids[keep]
    return keys, owners


TWINS = photometric, shade, skips, windowed, between


def _map(function: Callable[[Tensor], Tensor], value: Any) -> Any:
    if isinstance(value, Tensor):
        return function(value)
    if isinstance(value, Layer):
        return Layer(function(value.color), function(value.transmittance))
    if isinstance(value, (list, tuple)):
        parts = [_map(function, part) for part in value]
        return type(value)(*parts) if hasattr(value, "_fields") else type(value)(parts)
    return value


def _on_device(twin: Callable[..., Any]) -> Callable[..., Any]:
    def run(*given: Any) -> Any:
        tensors: list[Tensor] = []
        _map(lambda tensor: tensors.append(tensor) or tensor, given)
        if not isinstance(tensors[0], simulated_device.OnDevice) or tensors[0].dtype != torch.float32:
            return None

        def compute(*values: Tensor) -> Any:
            rest = iter(values)
            return twin(*_map(lambda _: next(rest), given))

        return simulated_device.kernel(compute, *tensors)

    run.runs = True
    return run


@contextmanager
def lent_triton() -> Iterator[None]:
    """Within, the simulated device has the package's kernels."""
    with pytest.MonkeyPatch.context() as patch:
        for twin in TWINS:
            patch.setattr(fused, twin.__name__, _on_device(twin))
        yield
