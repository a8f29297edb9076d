"""Where in an image projected Gaussians are."""

import math

import torch
from jaxtyping import Float, Real
from torch import Tensor

from abcd_ns.engine.types import View


def extents_of(
    means2d: Float[Tensor, "*c n 2"], radii: Real[Tensor, "*c n"], view: View
) -> Float[Tensor, "*c 4"]:
    """(left, top, right, bottom) of all that may be drawn in the image, px; infinite, the wrong way round,
    where nothing is.

    Args:
        means2d: centres in the full image, px.
        radii: half the sides of their squares, px; 0 where culled.
        view: gives the size of the image.
    """
    low, high = means2d - radii[..., None], means2d + radii[..., None]
    visible = (radii > 0) & (high > 0).all(dim=-1)
    visible = (visible & (low[..., 0] < view.width) & (low[..., 1] < view.height))[..., None]
    if means2d.shape[-2] == 0:
        return torch.cat((low.new_full((2,), math.inf), low.new_full((2,), -math.inf)))
    low = torch.where(visible, low, math.inf).amin(dim=-2)
    return torch.cat((low, torch.where(visible, high, -math.inf).amax(dim=-2)), dim=-1)
