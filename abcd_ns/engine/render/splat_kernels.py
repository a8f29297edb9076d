"""Gaussians and surfels as a camera sees them, in torch: the reference of kernels/cpp/projection.h. Rows are
quantities, columns are Gaussians."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.gaussians.spherical_harmonics import SH_C0, sh_basis_rows, sh_degree_of

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
MIN_ALPHA, MAX_ALPHA = 1.0 / 255.0, 0.999
"""Fragments with less alpha than the first are not drawn, none with more than the second."""
REACH_MARGIN = 0.01
"""Added to the squared Mahalanobis radius of the bounds, so that rounding never loses a fragment."""

X, Y, DEPTH, CONIC_XX, CONIC_XY, CONIC_YY = range(6)
"""Rows that `splat` gives: what is drawn, with gradients; then opacity, red, green and blue,"""
SPLAT_GRADED = 10
COV_XX, COV_XY, COV_YY = range(SPLAT_GRADED, SPLAT_GRADED + 3)
"""then bounds: the 2D covariance, blur included, and gsplat's radius."""
U, V, A, B, C, D, E, F = range(DEPTH + 1, DEPTH + 9)
"""Rows that `surfel` gives, after the middle x, y of the box around the ellipse of one standard deviation and
the camera z: the disc's middle on screen, the matrix; then opacity, red, green and blue,"""
SURFEL_GRADED = 15
"""then, without gradients, nothing in the three rows where splats have bounds, and gsplat's radius."""
MIN_EXTENT = 1e-4
"""Squared half sides of surfels' boxes are clamped to this, px^2."""


def splat(parameters: Float[Tensor, "p n"], camera: Float[Tensor, "c"]) -> Float[Tensor, "r n"]:
    """Project and colour Gaussians: gsplat's `fully_fused_projection` with its defaults, and 3DGS's colours.

    Colours are max(0, SH(direction) + 0.5), linear, not clamped from above. Covariances come as dot products
    of projected axes: never indefinite, and cheaper. Columns with radius 0 are finite and without meaning.

    Args:
        parameters: means x y z, log scales 3, quaternion w x y z, logit of the opacity, spherical harmonics
            of degree 0 (red, green, blue), then of degrees 1 to 3 (red, green, blue of each).
        camera: world-to-camera rotation 9 and translation 3, fx fy cx cy, width and height, 1 where opacities
            are compensated (antialiased) else 0, camera centre 3, near plane, 1 for each degree in use.
    """
    *scales, qw, qx, qy, qz, logit = parameters[3:11].unbind(0)
    number = camera.unbind(0)
    fx, fy, cx, cy, width, height, antialiased = number[12:19]
    depth, inverse_z, slope_x, slope_y, u, v = middles(parameters, number)
    axes = camera_axes(number[:9], (qw, qx, qy, qz), [scale.exp() for scale in scales])
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
    rows = [u, v, depth, yy / det, -xy / det, xx / det, opacity, *sh_color(parameters, number)]
    x, y, depth, xx, xy, yy, det = (value.detach() for value in (u, v, depth, xx, xy, yy, det))
    mid = 0.5 * (xx + yy)
    half = (mid + (mid * mid - det).clamp_min(0.01).sqrt()).sqrt()
    return torch.stack([*rows, xx, xy, yy, radius_of(x, y, depth, half, det > 0, number)])


def surfel(parameters: Float[Tensor, "p n"], camera: Float[Tensor, "c"]) -> Float[Tensor, "r n"]:
    """Project and colour surfels, discs that are each spread as a Gaussian in its own plane: gsplat's
    `fully_fused_projection_2dgs`, and 3DGS's colours.

    As `splat`, but the third scale is not looked at. A point (s, t) of the disc, in standard deviations from
    its middle, appears at the pixel

        ((A s + B t + u) / w, (C s + D t + v) / w),    w = E s + F t + 1

    where A .. F, u, v are the rows of 2DGS's splat-to-screen matrix (Huang et al. 2024; gsplat's ray
    transform), divided by the camera z of the disc's middle.
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


def middles(parameters: Float[Tensor, "p n"], number: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """Camera z of means, 1 / z, x / z and y / z, and pixels (u, v).

    What lies behind the camera is projected as if at z = 1: any finite value will do, its radius is 0.
    """
    x, y, z = parameters[:3].unbind(0)
    rotation, (tx, ty, tz), (fx, fy, cx, cy) = number[:9], number[9:12], number[12:16]
    mx = rotation[0] * x + rotation[1] * y + rotation[2] * z + tx
    my = rotation[3] * x + rotation[4] * y + rotation[5] * z + ty
    depth = rotation[6] * x + rotation[7] * y + rotation[8] * z + tz
    inverse_z = 1.0 / torch.where(depth >= number[22], depth, 1.0)
    slope_x, slope_y = mx * inverse_z, my * inverse_z
    return depth, inverse_z, slope_x, slope_y, fx * slope_x + cx, fy * slope_y + cy


def camera_axes(
    rotation: tuple[Tensor, ...], quaternion: tuple[Tensor, ...], deviations: list[Tensor]
) -> list[list[Tensor]]:
    """The Gaussian's three axes, one standard deviation long, in camera space: [component][axis]."""
    w, x, y, z = quaternion
    per_length = torch.rsqrt((w * w + x * x + y * y + z * z).clamp_min(TINY))
    columns = own_axes(w * per_length, x * per_length, y * per_length, z * per_length)
    return [
        [dot(rotation[3 * i : 3 * i + 3], columns[k]) * deviations[k] for k in range(3)] for i in range(3)
    ]


def own_axes(w: Tensor, x: Tensor, y: Tensor, z: Tensor) -> list[tuple[Tensor, Tensor, Tensor]]:
    """The columns of the rotation that a unit quaternion is."""
    return [
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    ]


def sh_color(parameters: Float[Tensor, "p n"], number: tuple[Tensor, ...]) -> list[Tensor]:
    """max(0, SH(direction) + 0.5): red, green, blue."""
    harmonics, in_use = parameters[11:].unbind(0), number[23:]
    away = [mean - center for mean, center in zip(parameters[:3].unbind(0), number[19:22], strict=True)]
    per_length = torch.rsqrt(dot(away, away).clamp_min(TINY))
    bases = sh_basis_rows(*[value * per_length for value in away])
    # Multiplied, not left out: coefficients of degrees not in use get a gradient of zeros, as gsplat gives
    # them; Adam counts such steps.
    bases = [basis * in_use[sh_degree_of(k)] for k, basis in enumerate(bases)]
    sums = [
        SH_C0 * harmonics[c] + sum(basis * harmonics[3 + 3 * k + c] for k, basis in enumerate(bases))
        for c in range(3)
    ]
    return [(value + 0.5).clamp_min(0.0) for value in sums]


def dot(a: Sequence[Tensor], b: Sequence[Tensor]) -> Tensor:
    """Of two vectors of rows."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _safe_sqrt(x: Tensor) -> Tensor:
    """The square root where x > 0, else 0 with a gradient of 0 instead of infinity."""
    positive = x > 0
    return torch.where(positive, torch.where(positive, x, 1.0).sqrt(), 0.0)


def radius_of(
    x: Tensor, y: Tensor, depth: Tensor, half: Tensor, is_sound: Tensor, number: tuple[Tensor, ...]
) -> Tensor:
    """3 sigma along the longer axis, where `half` is one, px; rounded up, 0 for what no pixel sees."""
    width, height, near = number[16], number[17], number[22]
    radius = (3.0 * half).ceil()
    drawn = (depth >= near) & (depth <= FAR_PLANE) & is_sound
    drawn = drawn & (x + radius > 0) & (x - radius < width) & (y + radius > 0) & (y - radius < height)
    return torch.where(drawn, radius.clamp_max(MAX_RADIUS), 0.0)
