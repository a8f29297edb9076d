"""Gaussians as a camera sees them, in torch: rows are quantities, columns are Gaussians.

The reference of kernels/cpp/projection.h.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.gaussians.spherical_harmonics import (
    BASES,
    MAX_SH_DEGREE,
    SH_C0,
    sh_basis_rows,
    sh_degree_of,
)

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


def splat(parameters: Float[Tensor, "p n"], camera: Float[Tensor, "c"]) -> Float[Tensor, "r n"]:
    """Project and colour Gaussians: gsplat's `fully_fused_projection` with its defaults, and 3DGS's colours.

    Colours are max(0, SH(direction) + 0.5), linear, not clamped from above. Covariances come as dot products
    of projected axes: never indefinite, and cheaper. Columns with radius 0 are finite and without meaning.
    """
    x, y, z, *scales, qw, qx, qy, qz, logit = parameters[:11].unbind(0)
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
    colors = sh_color(parameters[11:].unbind(0), [value * per_length for value in away], number[23:])
    rows = [u, v, depth, yy / det, -xy / det, xx / det, opacity, *colors]
    bounds = [value.detach() for value in (u, v, depth, xx, xy, yy, det)]
    return torch.stack([*rows, *bounds[3:6], _radius(*bounds, width, height, near)])


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


def _radius(u, v, depth, xx, _, yy, det, width, height, near) -> Tensor:
    """3 sigma along the longer axis, rounded up; 0 for what no pixel sees."""
    mid = 0.5 * (xx + yy)
    radius = (3.0 * (mid + (mid * mid - det).clamp_min(0.01).sqrt()).sqrt()).ceil()
    drawn = (depth >= near) & (depth <= FAR_PLANE) & (det > 0)
    drawn = drawn & (u + radius > 0) & (u - radius < width) & (v + radius > 0) & (v - radius < height)
    return torch.where(drawn, radius.clamp_max(MAX_RADIUS), 0.0)
