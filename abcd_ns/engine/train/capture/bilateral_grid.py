"""A colour transform that differs from place to place in a picture, and with brightness: a bilateral grid.

Made to filter photos by Chen, Paris and Durand (2007); for the photos of a scene, as here, Wang et al.,
*Bilateral Guided Radiance Field Processing*, SIGGRAPH 2024. Of splatfacto's size, and as smooth.
"""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.types import Crop, View

SHAPE = (8, 16, 16)
"""Transforms from dark to bright, from top to bottom, from left to right."""
TV_WEIGHT = 10.0
"""Of a grid's total variation in the loss of its whole picture."""
LUMA = (0.299, 0.587, 0.114)
"""Of red, green and blue: ITU-R BT.601."""


def sliced(
    grid: Float[Tensor, "12 l r c"], picture: Float[Tensor, "h w 3"], part: Crop, view: View
) -> Float[Tensor, "h w 3 4"]:
    """The transform of each pixel: between those of the grid, linearly in three directions, at the pixel's
    place in the whole picture and its luma. The outermost stand at the edges, at black and at white.

    Args:
        picture: a part of the view's.
    """
    like = {"dtype": picture.dtype, "device": picture.device}
    x = (torch.arange(part.x, part.x + part.width, **like) + 0.5) / view.width
    y = (torch.arange(part.y, part.y + part.height, **like) + 0.5) / view.height
    at = (x.expand(part.height, -1), y[:, None].expand(-1, part.width), picture @ picture.new_tensor(LUMA))
    where = 2 * torch.stack(at, dim=-1) - 1
    found = F.grid_sample(
        grid.to(picture.dtype)[None], where[None, None], align_corners=True, padding_mode="border"
    )
    return found[0, :, 0].permute(1, 2, 0).unflatten(-1, (3, 4))


def total_variation(grid: Float[Tensor, "12 l r c"]) -> Float[Tensor, ""]:
    """The mean square of differences between neighbours, summed over the three ways to be one."""
    return sum(grid.diff(dim=dim).square().mean() for dim in (1, 2, 3))


def of_total_variation(grid: Float[Tensor, "12 l r c"]) -> Float[Tensor, "12 l r c"]:
    """The gradient of `total_variation`."""
    leaf = grid.detach().requires_grad_()
    with torch.enable_grad():
        (gradient,) = torch.autograd.grad(total_variation(leaf), leaf)
    return gradient
