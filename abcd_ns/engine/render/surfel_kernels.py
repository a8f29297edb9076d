"""Surfels as a camera sees them, in torch: discs, each spread as a Gaussian in its own plane.

The counterpart of splat_kernels, which has the same parameters and cameras; the third scale is not looked
at. A point (s, t) of the disc, in standard deviations from its middle, appears at the pixel

    ((A s + B t + u) / w, (C s + D t + v) / w),    w = E s + F t + 1

where A .. F, u, v are the rows of 2DGS's splat-to-screen matrix (Huang et al. 2024; gsplat's ray transform),
divided by the camera z of the disc's middle.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.render.splat_kernels import DEPTH, X, Y, camera_axes, middles, radius_of, sh_color

U, V, A, B, C, D, E, F, OPACITY, RED, GREEN, BLUE = range(DEPTH + 1, DEPTH + 13)
"""Rows that `surfel` gives, after the middle x, y of the box around the ellipse of one standard deviation and
the camera z: the disc's middle on screen, the matrix, what it looks like,"""
GRADED = BLUE + 1
RADIUS = GRADED + 3
"""then, without gradients, nothing in the three rows where splats have bounds, and gsplat's radius."""
MIN_EXTENT = 1e-4
"""Squared half sides of boxes are clamped to this, px^2."""


def surfel(parameters: Float[Tensor, "p n"], camera: Float[Tensor, "c"]) -> Float[Tensor, "r n"]:
    """Project and colour surfels: gsplat's `fully_fused_projection_2dgs`, and 3DGS's colours.

    Columns with radius 0 are finite and without meaning.
    """
    wide, high, _, qw, qx, qy, qz, logit = parameters[3:11].unbind(0)
    number = camera.unbind(0)
    fx, fy = number[12:14]
    depth, inverse_z, slope_x, slope_y, u, v = middles(parameters, number)
    axes = camera_axes(number[:9], (qw, qx, qy, qz), [wide.exp(), high.exp(), torch.ones_like(wide)])
    across, down, away = ([component[k] * inverse_z for k in range(2)] for component in axes)
    # Relative to the middle: without the cancellation that large pixel numbers would bring.
    a, b = (fx * (across[k] - slope_x * away[k]) for k in range(2))
    c, d = (fy * (down[k] - slope_y * away[k]) for k in range(2))
    distance = away[0] * away[0] + away[1] * away[1] - 1
    per_distance = 1.0 / torch.where(distance == 0, 1.0, distance)
    off_x = (a * away[0] + b * away[1]) * per_distance
    off_y = (c * away[0] + d * away[1]) * per_distance

    colors = sh_color(parameters, number)
    matrix = [a + u * away[0], b + u * away[1], c + v * away[0], d + v * away[1], *away]
    rows = [u + off_x, v + off_y, depth, u, v, *matrix, torch.sigmoid(logit), *colors]
    extents = (off_x * off_x - (a * a + b * b) * per_distance, off_y * off_y - (c * c + d * d) * per_distance)
    extent_x, extent_y = (extent.detach() for extent in extents)
    half = extent_x.maximum(extent_y).clamp_min(MIN_EXTENT).sqrt()
    radius = radius_of(rows[X].detach(), rows[Y].detach(), depth.detach(), half, distance != 0, number)
    return torch.stack([*rows, *[torch.zeros_like(radius)] * 3, radius])


def relative_matrix(rows: Sequence[Tensor]) -> tuple[Tensor, ...]:
    """(a, b, c, d, e, f): the matrix with pixels counted from the disc's middle."""
    u, v, a, b, c, d, e, f = rows[U : F + 1]
    return a - u * e, b - u * f, c - v * e, d - v * f, e, f
