"""The algebra of layers: premultiplied colour C and transmittance T.

Over (Porter and Duff 1984, premultiplied; T = 1 - alpha):

    (C1, T1) over (C2, T2) = (C1 + T1 C2, T1 T2)

It is associative, so any run of layers collapses into one; the empty layer (0, 1) is its unit.
"""

from collections.abc import Sequence
from functools import reduce

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.types import Layer


def empty_layer(height: int, width: int, device: torch.device | str = "cpu", dtype=torch.float32) -> Layer:
    """A layer with nothing in it: C = 0, T = 1."""
    color = torch.zeros((height, width, 3), device=device, dtype=dtype)
    return Layer(color, torch.ones((height, width), device=device, dtype=dtype))


def over(front: Layer, behind: Layer) -> Layer:
    """One layer that looks like `front` drawn over `behind`: (C1 + T1 C2, T1 T2)."""
    color = torch.addcmul(front.color, front.transmittance[..., None], behind.color)
    return Layer(color, front.transmittance * behind.transmittance)


def fold(layers: Sequence[Layer], like: Layer | None = None) -> Layer:
    """All layers, given front to back, collapsed into one; none at all into an empty one like `like`."""
    if layers:
        return reduce(over, layers)
    return empty_layer(*like.transmittance.shape, like.color.device, like.color.dtype)


def composite(
    layer: Layer, background: Float[Tensor, "3"] | Float[Tensor, "h w 3"]
) -> Float[Tensor, "h w 3"]:
    """The picture of a layer on a background, linear colour: C + T bg."""
    return torch.addcmul(layer.color, layer.transmittance[..., None], background)


def sandwich(
    front: Layer, active: Layer, back: Layer, background: Float[Tensor, "3"] | Float[Tensor, "h w 3"]
) -> Float[Tensor, "h w 3"]:
    """The picture of the active block between all that is in front of it and all that is behind it.

        C = C_F + T_F (C_A + T_A (C_B + T_B bg))

    Differentiable. For the active layer, with dL/dC the gradient of a loss by the picture:

        dL/dC_A = T_F dL/dC        dL/dT_A = T_F <dL/dC, C_B + T_B bg>   (summed over channels)
    """
    return composite(front, composite(active, composite(back, background)))
