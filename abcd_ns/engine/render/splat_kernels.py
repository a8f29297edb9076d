"""What the torch rasterizer computes for each Gaussian, and for each row of tiles that it touches.

Every function is elementwise along its last dimension, so that a compiler fuses it into one loop: rows are
quantities, columns are Gaussians (or bands). See `kernels.Kernel`.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.gaussians import spherical_harmonics
from abcd_ns.engine.gaussians.spherical_harmonics import (
    BASES,
    MAX_SH_DEGREE,
    SH_C0,
    sh_basis_rows,
    sh_degree_of,
)
from abcd_ns.engine.kernels import Kernel

FAR_PLANE = 1e10
"""Gaussians with a larger camera z are not drawn; world units."""
EPS_2D = 0.3
"""Added to both variances of a projected Gaussian, so that none is thinner than a pixel; square pixels."""
MAX_RADIUS = 2**24
"""Radii are clamped to this, so that none overflows an int32; pixels. Up to it, float32 holds integers."""
TINY = 1e-24
"""Squared lengths are clamped to this before dividing by their root."""
GSPLAT_TILE = 16
"""gsplat's tile size in pixels; decides which pixels a Gaussian may touch."""
MIN_ALPHA = 1.0 / 255.0
"""Fragments with less alpha are not drawn."""
REACH_MARGIN = 0.01
"""Added to the squared Mahalanobis radius of the bounds, so that rounding never loses a fragment."""

PARAMETERS = 14 + 3 * BASES
"""Rows that `splat` takes: means x y z, log scales 3, quaternion w x y z, logit of the opacity, spherical
harmonics of degree 0 (red, green, blue), then of degrees 1 to 3 (red, green, blue of each)."""
CAMERA = 23 + MAX_SH_DEGREE
"""Numbers of a camera: world-to-camera rotation 9 and translation 3, fx fy cx cy, width and height, 1 where
opacities are compensated (antialiased) else 0, camera centre 3, near plane, 1 for each degree of harmonics in
use."""
X, Y, DEPTH, CONIC_XX, CONIC_XY, CONIC_YY, OPACITY, RED, GREEN, BLUE = range(10)
"""Rows that `splat` gives: what is drawn, with gradients,"""
GRADED = BLUE + 1
COV_XX, COV_XY, COV_YY, RADIUS = range(GRADED, GRADED + 4)
"""then bounds: the 2D covariance, blur included, and gsplat's radius."""
SPLAT_ROWS = RADIUS + 1


def splat(parameters: Float[Tensor, "p n"], camera: Float[Tensor, "c"]) -> tuple[Float[Tensor, "r n"]]:
    """Project and colour Gaussians: gsplat's `fully_fused_projection` with its defaults, and 3DGS's colours.

    Colours are max(0, SH(direction) + 0.5), linear, not clamped from above. Covariances come as dot products
    of projected axes: never indefinite, and cheaper. Columns with radius 0 are finite and without meaning.
    """
    return (torch.stack(_graded_rows(parameters.unbind(0), camera, bounds=True)),)


def splat_backward(
    parameters: Float[Tensor, "p n"], camera: Float[Tensor, "c"], grad: Float[Tensor, "g n"]
) -> tuple[Float[Tensor, "p n"]]:
    """Gradient of `parameters` from that of the GRADED rows; everything else is computed again.

    Row by row: the gradient of a slice of a matrix is as large as the matrix, and there are a hundred slices.
    """
    _, pull = torch.func.vjp(lambda *rows: _graded_rows(rows, camera, bounds=False), *parameters.unbind(0))
    return (torch.stack(pull(list(grad.unbind(0)))),)


def _graded_rows(parameters: Sequence[Tensor], camera: Tensor, bounds: bool) -> list[Tensor]:
    x, y, z, *scales, qw, qx, qy, qz, logit = parameters[:11]
    number = camera.unbind(0)
    rotation, (tx, ty, tz) = number[:9], number[9:12]
    fx, fy, cx, cy, width, height, antialiased = number[12:19]
    near = number[22]
    mx = rotation[0] * x + rotation[1] * y + rotation[2] * z + tx
    my = rotation[3] * x + rotation[4] * y + rotation[5] * z + ty
    depth = rotation[6] * x + rotation[7] * y + rotation[8] * z + tz
    # What lies behind the camera is projected as if at z = 1: any finite value will do, its radius is 0.
    inverse_z = 1.0 / torch.where(depth >= near, depth, 1.0)
    slope_x, slope_y = mx * inverse_z, my * inverse_z
    u, v = fx * slope_x + cx, fy * slope_y + cy

    axes = camera_axes(rotation, (qw, qx, qy, qz), [scale.exp() for scale in scales])
    # As in gsplat, the Jacobian is taken at a centre clamped to 1.3 times the image's field of view: further
    # out the linearisation explodes.
    margin_x, margin_y = 0.15 * width / fx, 0.15 * height / fy
    slope_x = slope_x.maximum(-cx / fx - margin_x).minimum((width - cx) / fx + margin_x)
    slope_y = slope_y.maximum(-cy / fy - margin_y).minimum((height - cy) / fy + margin_y)
    across = [fx * inverse_z * (axes[0][k] - slope_x * axes[2][k]) for k in range(3)]
    down = [fy * inverse_z * (axes[1][k] - slope_y * axes[2][k]) for k in range(3)]
    xx, xy, yy = dot(across, across), dot(across, down), dot(down, down)
    # Lagrange's identity: xx yy - xy^2 = |across x down|^2, without the cancellation.
    normal = [across[i] * down[j] - across[j] * down[i] for i, j in ((1, 2), (2, 0), (0, 1))]
    det_sharp = dot(normal, normal)
    det = det_sharp + EPS_2D * (xx + yy) + EPS_2D * EPS_2D
    xx, yy = xx + EPS_2D, yy + EPS_2D

    opacity = torch.sigmoid(logit)
    opacity = opacity * torch.where(antialiased > 0, _safe_sqrt(det_sharp / det), 1.0)
    away = [x - number[19], y - number[20], z - number[21]]
    per_length = torch.rsqrt(dot(away, away).clamp_min(TINY))
    colors = sh_color(parameters[11:], [value * per_length for value in away], number[23:])
    rows = [u, v, depth, yy / det, -xy / det, xx / det, opacity, *colors]
    return [*rows, xx, xy, yy, _radius(u, v, depth, xx, yy, det, width, height, near)] if bounds else rows


def camera_axes(
    rotation: tuple[Tensor, ...], quaternion: tuple[Tensor, ...], deviations: list[Tensor]
) -> list[list[Tensor]]:
    """The Gaussian's three axes, one standard deviation long, in camera space: [component][axis]."""
    w, x, y, z = quaternion
    per_length = torch.rsqrt((w * w + x * x + y * y + z * z).clamp_min(TINY))
    w, x, y, z = w * per_length, x * per_length, y * per_length, z * per_length
    turned = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    columns = [[row[k] for row in turned] for k in range(3)]
    return [
        [dot(rotation[3 * i : 3 * i + 3], columns[k]) * deviations[k] for k in range(3)] for i in range(3)
    ]


def sh_color(
    harmonics: Sequence[Tensor], direction: list[Tensor], in_use: tuple[Tensor, ...]
) -> list[Tensor]:
    """max(0, SH(direction) + 0.5): red, green, blue."""
    bases = sh_basis_rows(*direction)
    # Multiplied, not left out: coefficients of degrees not in use get a gradient of zeros, as gsplat gives
    # them; Adam counts such steps.
    bases = [basis * in_use[sh_degree_of(k)] for k, basis in enumerate(bases)]
    sums = [
        SH_C0 * harmonics[c] + sum(basis * harmonics[3 + 3 * k + c] for k, basis in enumerate(bases))
        for c in range(3)
    ]
    return [(value + 0.5).clamp_min(0.0) for value in sums]


def dot(a: list[Tensor] | tuple[Tensor, ...], b: list[Tensor]) -> Tensor:
    """Of two vectors of rows."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _safe_sqrt(x: Tensor) -> Tensor:
    """The square root where x > 0, else 0 with a gradient of 0 instead of infinity."""
    positive = x > 0
    return torch.where(positive, torch.where(positive, x, 1.0).sqrt(), 0.0)


def _radius(u, v, depth, xx, yy, det, width, height, near) -> Tensor:
    """3 sigma along the longer axis, rounded up; 0 for what no pixel sees."""
    mid = 0.5 * (xx + yy)
    radius = (3.0 * (mid + (mid * mid - det).clamp_min(0.01).sqrt()).sqrt()).ceil()
    drawn = (depth >= near) & (depth <= FAR_PLANE) & (det > 0)
    drawn = drawn & (u + radius > 0) & (u - radius < width) & (v + radius > 0) & (v - radius < height)
    return torch.where(drawn, radius.clamp_max(MAX_RADIUS), 0.0)


# -- which tiles --------------------------------------------------------------------------------------------

GRID = 5
"""Numbers of a tile grid: the crop's x, y, width and height, and the side of a tile; pixels."""
REACH, SLOPE, PRECISION, FLANK, LOW, HIGH, VARIANCE, LEFT, WIDTH, SIDE, BAND_ROWS = range(2, 13)
"""Rows of a band, after x and y of the mean: the squared Mahalanobis radius at which alpha falls to 1/255;
how the middle of the ellipse shifts with height; 1 over its variance at a given height; the height at which
it is furthest to the right; the first and last column that gsplat would draw; the variance of the height;
and of the grid the crop's first column, its width, and the side of a tile."""


def tile_rows(
    splats: Float[Tensor, "r n"], grid: Float[Tensor, "g n"]
) -> tuple[Float[Tensor, "2 n"], Float[Tensor, "b n"]]:
    """(first row of tiles, number of rows) that each Gaussian reaches, and its band's quantities.

    The number is 0 for what leaves no fragment in the crop. Each Gaussian has its own grid, so that one call
    serves several views.
    """
    left, top, width, height, side = grid.unbind(0)
    x, y, radius = splats[X], splats[Y], splats[RADIUS]
    xx, xy, yy = splats[COV_XX], splats[COV_XY], splats[COV_YY]
    seen = (radius > 0) & (splats[OPACITY] >= MIN_ALPHA)
    seen = seen & (x + radius + GSPLAT_TILE > left) & (x - radius - GSPLAT_TILE < left + width)
    reach = 2.0 * (splats[OPACITY] / MIN_ALPHA).log().clamp_min(0) + REACH_MARGIN
    half_height = (reach * yy).sqrt()
    first, count = tile_span(y - half_height, y + half_height, *gsplat_bounds(y, radius), top, height, side)
    flank = xy * (reach / xx).sqrt()
    low, high = gsplat_bounds(x, radius)
    band = (x, y, reach, xy / yy, splats[CONIC_XX], flank, low, high, yy, left, width, side)
    return torch.stack((first, torch.where(seen, count, 0.0))), torch.stack(band)


def tile_columns(bands: Float[Tensor, "b q"], rows: Float[Tensor, "q"]) -> tuple[Float[Tensor, "2 q"]]:
    """(first tile, number of tiles) that the ellipse reaches in one row of tiles.

    Within the row's pixel centres, at height v over the mean, the ellipse spans v xy / yy -+ half; its right
    end is furthest out at v = the top of the right flank, its left end at minus that.
    """
    x, y, reach, variance, side = bands[X], bands[Y], bands[REACH], bands[VARIANCE], bands[SIDE]
    first = rows * side + 0.5 - y
    last = first + (side - 1)
    right_v = bands[FLANK].maximum(first).minimum(last)
    left_v = (-bands[FLANK]).maximum(first).minimum(last)
    right_half = ((reach - right_v * right_v / variance).clamp_min(0) / bands[PRECISION]).sqrt()
    left_half = ((reach - left_v * left_v / variance).clamp_min(0) / bands[PRECISION]).sqrt()
    low, high = x + left_v * bands[SLOPE] - left_half, x + right_v * bands[SLOPE] + right_half
    return (torch.stack(tile_span(low, high, bands[LOW], bands[HIGH], bands[LEFT], bands[WIDTH], side)),)


def gsplat_bounds(mean: Tensor, radius: Tensor) -> tuple[Tensor, Tensor]:
    """First and last pixel, along one axis, of the 16 px tiles that the square of the radius touches."""
    first = (mean / GSPLAT_TILE - radius / GSPLAT_TILE).floor() * GSPLAT_TILE
    last = (mean / GSPLAT_TILE + radius / GSPLAT_TILE).ceil() * GSPLAT_TILE - 1
    return first, last


def tile_span(low, high, first_bound, last_bound, start, size, side) -> tuple[Tensor, Tensor]:
    """The tiles along one axis with a pixel centre in [low, high], in the crop and within the bounds.

    Returns (first tile, counted from the image's edge; number of tiles).
    """
    first = (low - 0.5).ceil().maximum(first_bound).maximum(start).minimum(start + size)
    last = (high - 0.5).floor().minimum(last_bound).maximum(start - 1).minimum(start + size - 1)
    first_tile, last_tile = (first / side).floor(), (last / side).floor()
    return first_tile, torch.where(first <= last, last_tile - first_tile + 1, 0.0)


_SH = (spherical_harmonics.__file__,)
SPLAT = Kernel("splat", splat, (f"{PARAMETERS} n", f"{CAMERA}"), _SH)
SPLAT_BACKWARD = Kernel(
    "splat-backward", splat_backward, (f"{PARAMETERS} n", f"{CAMERA}", f"{GRADED} n"), _SH
)
TILE_ROWS = Kernel("tile-rows", tile_rows, (f"{SPLAT_ROWS} n", f"{GRID} n"), _SH)
TILE_COLUMNS = Kernel("tile-columns", tile_columns, (f"{BAND_ROWS} q", "q"), _SH)
