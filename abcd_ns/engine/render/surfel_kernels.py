"""What the torch rasterizer computes for each surfel: a disc, spread as a Gaussian in its own plane.

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

from abcd_ns.engine.gaussians import spherical_harmonics
from abcd_ns.engine.kernels import Kernel
from abcd_ns.engine.render import splat_kernels
from abcd_ns.engine.render.splat_kernels import (
    CAMERA,
    DEPTH,
    FAR_PLANE,
    GRID,
    GSPLAT_TILE,
    MAX_RADIUS,
    MIN_ALPHA,
    PARAMETERS,
    REACH_MARGIN,
    TINY,
    X,
    Y,
    camera_axes,
    dot,
    gsplat_bounds,
    sh_color,
    tile_span,
)

U, V, A, B, C, D, E, F, OPACITY, RED, GREEN, BLUE = range(DEPTH + 1, DEPTH + 13)
"""Rows that `surfel` gives, after the middle x, y of the box around the ellipse of one standard deviation and
the camera z: the disc's middle on screen, the matrix, what it looks like,"""
GRADED = BLUE + 1
RADIUS = GRADED + 3
"""then, without gradients, nothing in the three rows where splats have bounds, and gsplat's radius."""
SURFEL_ROWS = RADIUS + 1
MIN_EXTENT = 1e-4
"""Squared half sides of boxes are clamped to this, px^2."""
CROSSING = -0.01
"""Discs of which more than so much is in front of the camera's plane have a bound of their own."""


def surfel(parameters: Float[Tensor, "p n"], camera: Float[Tensor, "c"]) -> tuple[Float[Tensor, "r n"]]:
    """Project and colour surfels: gsplat's `fully_fused_projection_2dgs`, and 3DGS's colours.

    Columns with radius 0 are finite and without meaning.
    """
    return (torch.stack(_surfel_rows(parameters.unbind(0), camera, bounds=True)),)


def surfel_backward(
    parameters: Float[Tensor, "p n"], camera: Float[Tensor, "c"], grad: Float[Tensor, "g n"]
) -> tuple[Float[Tensor, "p n"]]:
    """Gradient of `parameters` from that of the GRADED rows; see splat_kernels.splat_backward."""
    _, pull = torch.func.vjp(lambda *rows: _surfel_rows(rows, camera, bounds=False), *parameters.unbind(0))
    return (torch.stack(pull(list(grad.unbind(0)))),)


def _surfel_rows(parameters: Sequence[Tensor], camera: Tensor, bounds: bool) -> list[Tensor]:
    x, y, z, wide, high, _, qw, qx, qy, qz, logit = parameters[:11]
    number = camera.unbind(0)
    rotation, (tx, ty, tz) = number[:9], number[9:12]
    fx, fy, cx, cy, width, height = number[12:18]
    near = number[22]
    mx = rotation[0] * x + rotation[1] * y + rotation[2] * z + tx
    my = rotation[3] * x + rotation[4] * y + rotation[5] * z + ty
    depth = rotation[6] * x + rotation[7] * y + rotation[8] * z + tz
    inverse_z = 1.0 / torch.where(depth >= near, depth, 1.0)
    slope_x, slope_y = mx * inverse_z, my * inverse_z
    u, v = fx * slope_x + cx, fy * slope_y + cy

    axes = camera_axes(rotation, (qw, qx, qy, qz), [wide.exp(), high.exp(), torch.ones_like(wide)])
    across, down, away = ([component[k] * inverse_z for k in range(2)] for component in axes)
    # Relative to the middle: without the cancellation that large pixel numbers would bring.
    a, b = (fx * (across[k] - slope_x * away[k]) for k in range(2))
    c, d = (fy * (down[k] - slope_y * away[k]) for k in range(2))
    distance = away[0] * away[0] + away[1] * away[1] - 1
    per_distance = 1.0 / torch.where(distance == 0, 1.0, distance)
    off_x = (a * away[0] + b * away[1]) * per_distance
    off_y = (c * away[0] + d * away[1]) * per_distance

    view = [x - number[19], y - number[20], z - number[21]]
    per_length = torch.rsqrt(dot(view, view).clamp_min(TINY))
    colors = sh_color(parameters[11:], [value * per_length for value in view], number[23:])
    matrix = [a + u * away[0], b + u * away[1], c + v * away[0], d + v * away[1], *away]
    rows = [u + off_x, v + off_y, depth, u, v, *matrix, torch.sigmoid(logit), *colors]
    if not bounds:
        return rows
    extent_x = off_x * off_x - (a * a + b * b) * per_distance
    extent_y = off_y * off_y - (c * c + d * d) * per_distance
    radius = (3.0 * extent_x.maximum(extent_y).clamp_min(MIN_EXTENT).sqrt()).ceil()
    box_x, box_y = rows[X], rows[Y]
    drawn = (depth >= near) & (depth <= FAR_PLANE) & (distance != 0)
    drawn = drawn & (box_x + radius > 0) & (box_x - radius < width)
    drawn = drawn & (box_y + radius > 0) & (box_y - radius < height)
    nothing = torch.zeros_like(radius)
    return [*rows, nothing, nothing, nothing, torch.where(drawn, radius.clamp_max(MAX_RADIUS), 0.0)]


def relative_matrix(rows: Sequence[Tensor]) -> tuple[Tensor, ...]:
    """(a, b, c, d, e, f): the matrix with pixels counted from the disc's middle."""
    u, v, a, b, c, d, e, f = rows[U : F + 1]
    return a - u * e, b - u * f, c - v * e, d - v * f, e, f


def surfel_tile_rows(
    surfels: Float[Tensor, "r n"], grid: Float[Tensor, "g n"]
) -> tuple[Float[Tensor, "2 n"], Float[Tensor, "b n"]]:
    """(first row of tiles, number of rows) that each surfel may reach, and its band; see
    splat_kernels.tile_rows.

    Alpha reaches 1/255 where s^2 + t^2 is at most k, which is an ellipse on screen, or in a circle of radius
    sqrt(k / 2) around the box's middle, for gsplat's low-pass filter. An ellipse around both is the bound:
    that of the disc, with the square of the circle's reach from its middle added to both variances.
    """
    left, top, width, height, side = grid.unbind(0)
    x, y, radius, opacity = surfels[X], surfels[Y], surfels[RADIUS], surfels[OPACITY]
    seen = (radius > 0) & (opacity >= MIN_ALPHA)
    seen = seen & (x + radius + GSPLAT_TILE > left) & (x - radius - GSPLAT_TILE < left + width)
    k = 2.0 * (opacity / MIN_ALPHA).log().clamp_min(0) + REACH_MARGIN

    a, b, c, d, e, f = relative_matrix(surfels.unbind(0))
    distance = k * (e * e + f * f) - 1
    whole = distance < CROSSING
    per_distance = 1.0 / torch.where(whole, distance, -1.0)
    scale = k * per_distance
    off_x, off_y = scale * (a * e + b * f), scale * (c * e + d * f)
    xx, yy = off_x * off_x - scale * (a * a + b * b), off_y * off_y - scale * (c * c + d * d)
    xy = off_x * off_y - scale * (a * c + b * d)
    gap = ((surfels[U] + off_x - x).square() + (surfels[V] + off_y - y).square()).sqrt()
    margin = ((0.5 * k).sqrt() + gap).square()
    # Cauchy-Binet: without the cancellation of xx yy - xy^2.
    det = -((a * d - b * c) * scale).square() * per_distance + margin * (xx + yy) + margin * margin
    # A disc that crosses the camera's plane has no ellipse: anything that holds gsplat's tiles will do.
    around = (2 * (radius + GSPLAT_TILE)).square()
    middle_x, middle_y = torch.where(whole, surfels[U] + off_x, x), torch.where(whole, surfels[V] + off_y, y)
    xx, yy = torch.where(whole, xx + margin, around), torch.where(whole, yy + margin, around)
    xy, det = torch.where(whole, xy, 0.0), torch.where(whole, det, around * around)

    rows = gsplat_bounds(y, radius)
    first, count = tile_span(middle_y - yy.sqrt(), middle_y + yy.sqrt(), *rows, top, height, side)
    reach, (low, high) = torch.ones_like(x), gsplat_bounds(x, radius)
    shape = (reach, xy / yy, yy / det, xy / xx.sqrt(), low, high, yy)
    band = (middle_x, middle_y, *shape, left, width, side)
    return torch.stack((first, torch.where(seen, count, 0.0))), torch.stack(band)


_DEPENDS = (splat_kernels.__file__, spherical_harmonics.__file__)
SURFEL = Kernel("surfel", surfel, (f"{PARAMETERS} n", f"{CAMERA}"), _DEPENDS)
SURFEL_BACKWARD = Kernel(
    "surfel-backward", surfel_backward, (f"{PARAMETERS} n", f"{CAMERA}", f"{GRADED} n"), _DEPENDS
)
SURFEL_TILE_ROWS = Kernel("surfel-tile-rows", surfel_tile_rows, (f"{SURFEL_ROWS} n", f"{GRID} n"), _DEPENDS)
