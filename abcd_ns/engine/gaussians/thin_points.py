"""Points that photos cannot tell apart are one point.

A reconstruction is made from photos of full size, and may have dozens of points where the pictures that are
trained on have one pixel. A Gaussian for each would be more than any picture can show: what is finer than
half a pixel's width by sampling theory, and finer than the rasterizer's low-pass filter, of some pixel's
width, in practice.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.types import View

MOST_VIEWS = 500
"""Of more than these, an evenly spaced choice is looked at."""


def thin_points(
    points: Float[Tensor, "n 3"], colors: Float[Tensor, "n 3"], views: Sequence[View], pixels: float
) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 3"]]:
    """One point, the mean of place and colour, for all that lie in one small cube.

    Cubes have sides of powers of 2: the largest that are no larger than `pixels` pixels of the view that sees
    the point from nearest. Points that no view sees stay as they are.

    Args:
        points: world space.
        pixels: 0 leaves all points as they are.
    """
    if pixels <= 0 or len(points) == 0:
        return points, colors
    size = pixels * finest_pixel(points, views)
    level = torch.where(size.isfinite(), size.clamp_min(1e-30).log2().floor(), -100.0)
    cells = torch.floor(points.double() / torch.exp2(level)[:, None])
    alone = torch.where(size.isfinite(), -1.0, torch.arange(len(points)).double())
    keys = torch.cat((level[:, None], alone[:, None], cells * size.isfinite()[:, None]), dim=1)
    _, owner, count = torch.unique(keys, dim=0, return_inverse=True, return_counts=True)
    means = [
        values.new_zeros(len(count), 3, dtype=torch.float64).index_add_(0, owner, values.double())
        for values in (points, colors)
    ]
    return tuple((total / count[:, None]).to(points.dtype) for total in means)


def finest_pixel(points: Float[Tensor, "n 3"], views: Sequence[View]) -> Float[Tensor, "n"]:
    """How wide a pixel is at each point, world units, in the view that sees it from nearest; infinite where
    none does."""
    finest = points.new_full((len(points),), torch.inf, dtype=torch.float64)
    for view in views[:: -(-len(views) // MOST_VIEWS) or 1]:
        z, seen = view.depths_of(points)
        pixel = (z / view.K[0, 0].to(points)).double()
        finest = torch.where(seen, torch.minimum(finest, pixel), finest)
    return finest
