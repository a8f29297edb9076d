"""What of a block can be seen where: footprints in the image, and reach into cells."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from abcd_ns.engine.render.primitive import DRAWN_SIGMAS
from abcd_ns.engine.space.tree import Box, in_float64
from abcd_ns.engine.types import Crop, View


def footprint(extent: Sequence[float], view: View, margin: int = 0, align: int = 16) -> Crop | None:
    """The smallest aligned crop that holds everything that some projected Gaussians can draw.

    Args:
        extent: where that is: (left, top, right, bottom), px; see Rasterizer.extents.
        margin: grow by this many px (a loss that looks at neighbouring pixels needs it).
        align: move the edges outward to multiples of this many px, or to the image's border. With the
            rasterizer's tile size (gsplat's is 16) no pixel is missed: it draws a Gaussian on all of
            each tile that its square touches, which may be beyond the square.

    Returns:
        The crop, or None if nothing is in the image.
    """
    x0, y0, x1, y1 = extent
    if x0 > x1:
        return None
    x, width = _aligned_span(x0, x1, view.width, margin, align)
    y, height = _aligned_span(y0, y1, view.height, margin, align)
    return Crop(x, y, width, height)


def reach_radius(scales: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """DRAWN_SIGMAS standard deviations along each Gaussian's longest axis, world units; `scales` are logs."""
    return DRAWN_SIGMAS * scales.amax(dim=1).exp()


def widest_slant(views: Sequence[View]) -> float:
    """How much longer a Gaussian may be drawn at its own camera z than it is: 1 / cos of the widest angle.

    Splatting projects along the line of sight onto the plane of the mean's camera z: there an offset
    (dx, dy, dz) lands at (dx - dz x/z, dy - dz y/z), longer by sqrt(1 + (x/z)^2 + (y/z)^2) at most. gsplat
    clamps x/z at the image's border plus 0.15 of its width (0.3 tan of half the field of view); y/z alike.
    """
    K = in_float64(torch.stack([view.K for view in views])).cpu()
    size = torch.tensor([(view.width, view.height) for view in views], dtype=torch.float64)
    middle, focal = K[:, :2, 2], K[:, :2, :2].diagonal(dim1=1, dim2=2)
    limits = (torch.maximum(middle, size - middle) + 0.15 * size) / focal
    return float((1 + limits.square().sum(dim=1)).sqrt().max())


def reaches(
    means: Float[Tensor, "n 3"],
    scales: Float[Tensor, "n 3"],
    box: Box,
    slack: Float[Tensor, "n"],
    slant: float,
) -> Bool[Tensor, "n"]:
    """Whether any fragment of each Gaussian may lie in `box`, from any view: False is certain.

    True where the distance from the mean to the box is at most slant * reach_radius + slack.

    Args:
        slack: what the screen adds, world units: its blur (at most, as sqrt(a^2 + b^2) <= a + b), and half a
            tile's diagonal, as a fragment's place is looked up on the ray through the middle of its tile.
        slant: the `widest_slant` of the views in question.
    """
    outside = torch.maximum(box.lower.to(means) - means, means - box.upper.to(means)).clamp(min=0)
    return outside.norm(dim=1) <= slant * reach_radius(scales) + slack


def straddles(
    means: Float[Tensor, "n 3"],
    scales: Float[Tensor, "n 3"],
    box: Box,
    slack: Float[Tensor, "n"],
    slant: float,
) -> Bool[Tensor, "n"]:
    """Whether any fragment of each Gaussian may lie outside `box`; see `reaches`."""
    inside = torch.minimum(means - box.lower.to(means), box.upper.to(means) - means).amin(dim=1)
    return ~(inside > slant * reach_radius(scales) + slack)


def _aligned_span(low: float, high: float, size: int, margin: int, align: int) -> tuple[int, int]:
    """(first pixel, number of pixels) of [low, high] grown, aligned outward and clipped to 0 .. size."""
    start = (math.floor(max(low, 0.0)) - margin) // align * align
    stop = -((-math.ceil(min(high, float(size))) - margin) // align) * align
    start, stop = max(start, 0), min(stop, size)
    return start, stop - start
