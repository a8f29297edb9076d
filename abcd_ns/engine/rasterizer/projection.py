"""Perspective projection of 3D Gaussians to 2D ones (EWA splatting), as gsplat 1.4.0 does it."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from abcd_ns.engine.types import Gaussians, View

NEAR_PLANE = 0.01
"""Gaussians with a smaller camera z are not drawn; world units."""
FAR_PLANE = 1e10
"""Gaussians with a larger camera z are not drawn; world units."""
EPS_2D = 0.3
"""Added to both variances of a projected Gaussian, so that none is thinner than a pixel; square pixels."""
MAX_RADIUS = 2**24
"""Radii are clamped to this, so that none overflows an int32; pixels."""


@dataclass(frozen=True)
class Splats:
    """N Gaussians as one camera sees them: what a rasterizer draws. Pixels of the full image throughout."""

    means2d: Float[Tensor, "n 2"]
    """Centres (x, y)."""
    covs2d: Float[Tensor, "n 3"]
    """Covariances (xx, xy, yy), blur included; without gradient, for bounds only."""
    conics: Float[Tensor, "n 3"]
    """Inverses of the covariances (xx, xy, yy)."""
    depths: Float[Tensor, "n"]
    """Camera z of the 3D centres, world units."""
    radii: Int[Tensor, "n"]
    """3 sigma along the longer axis, rounded up; 0 for what no pixel sees."""
    opacities: Float[Tensor, "n"]
    """After the sigmoid and, if antialiased, after compensation."""

    def __len__(self) -> int:
        return self.means2d.shape[0]

    @staticmethod
    def cat(first: "Splats", second: "Splats") -> "Splats":
        """Both in one list."""
        pairs = ((getattr(first, name), getattr(second, name)) for name in Splats.__dataclass_fields__)
        return Splats(*(torch.cat(pair) for pair in pairs))


def _rotation_matrices(quats: Float[Tensor, "n 4"]) -> Float[Tensor, "3 3 n"]:
    """Rotation matrices of quaternions (w, x, y, z), which need not be normalised; layout as in project."""
    w, x, y, z = F.normalize(quats.T.contiguous(), dim=0).unbind(0)
    rows = (
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack(rows).view(3, 3, -1)


def _image_axes(
    means_c: Float[Tensor, "3 n"], z: Float[Tensor, "n"], axes_c: Float[Tensor, "3 3 n"], view: View
) -> tuple[Float[Tensor, "3 n"], Float[Tensor, "3 n"]]:
    """The x and y components of each Gaussian's three scaled axes, projected by the Jacobian J at its centre.

    With axes V (columns), the 2D covariance is J V V^T J^T, so its entries are dot products of these rows.
    As in gsplat, J is taken at a centre clamped to 1.3 times the image's field of view: further out the
    linearisation explodes.
    """
    fx, fy, cx, cy = view.K[0, 0], view.K[1, 1], view.K[0, 2], view.K[1, 2]
    margin_x, margin_y = 0.15 * view.width / fx, 0.15 * view.height / fy
    slope_x = (means_c[0] / z).clamp(-cx / fx - margin_x, (view.width - cx) / fx + margin_x)
    slope_y = (means_c[1] / z).clamp(-cy / fy - margin_y, (view.height - cy) / fy + margin_y)
    return (fx / z) * (axes_c[0] - slope_x * axes_c[2]), (fy / z) * (axes_c[1] - slope_y * axes_c[2])


def _safe_sqrt(x: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
    """The square root where x > 0, else 0 with a gradient of 0 instead of infinity."""
    positive = x > 0
    return torch.where(positive, torch.where(positive, x, 1.0).sqrt(), 0.0)


@torch.no_grad()
def _radii(
    means2d: Float[Tensor, "2 n"],
    xx: Tensor,
    yy: Tensor,
    det: Float[Tensor, "n"],
    z: Float[Tensor, "n"],
    view: View,
) -> Int[Tensor, "n"]:
    mid = 0.5 * (xx + yy)
    largest = mid + (mid * mid - det).clamp_min(0.01).sqrt()
    radii = (3.0 * largest.sqrt()).ceil()
    drawn = (z >= NEAR_PLANE) & (z <= FAR_PLANE) & (det > 0)
    for center, size in zip(means2d, (view.width, view.height), strict=True):
        drawn &= (center + radii > 0) & (center - radii < size)
    return torch.where(drawn, radii.clamp_max(MAX_RADIUS), 0).int()


def project(gaussians: Gaussians, view: View, *, antialiased: bool = False) -> Splats:
    """Project Gaussians into a view; differentiable in the Gaussians, and in the pose if it takes gradients.

    Mathematically gsplat's `fully_fused_projection` with its defaults (near 0.01, far 1e10, blur 0.3 px^2),
    though covariances come as dot products of projected axes: never indefinite, and cheaper. Inside, the
    Gaussians are the last dimension, so that every operation runs along contiguous memory. Rows with radius
    0 hold finite values that mean nothing.

    Args:
        antialiased: multiply opacities by sqrt(det(cov) / det(cov + blur)), as in Mip-Splatting.
    """
    viewmat, K = view.viewmat.to(gaussians.means), view.K.to(gaussians.means)
    view = View(viewmat, K, view.width, view.height, view.index)
    means_c = viewmat[:3, :3] @ gaussians.means.T + viewmat[:3, 3:]
    depths = means_c[2]
    # What lies behind the camera is projected as if at z = 1: any finite value will do, its radius is 0.
    z = torch.where(depths >= NEAR_PLANE, depths, 1.0)
    means2d = torch.stack((K[0, 0] * means_c[0] / z + K[0, 2], K[1, 1] * means_c[1] / z + K[1, 2]))

    rotations = _rotation_matrices(gaussians.quats)
    axes_c = (viewmat[:3, :3] @ rotations.view(3, -1)).view_as(rotations) * gaussians.scales.T.exp()
    x_axes, y_axes = _image_axes(means_c, z, axes_c, view)
    xx, xy, yy = ((a * b).sum(0) for a, b in ((x_axes, x_axes), (x_axes, y_axes), (y_axes, y_axes)))
    # Lagrange's identity: xx yy - xy^2 = |x_axes x y_axes|^2, without the cancellation.
    det_sharp = torch.linalg.cross(x_axes, y_axes, dim=0).square().sum(0)
    det = det_sharp + EPS_2D * (xx + yy) + EPS_2D * EPS_2D
    xx, yy = xx + EPS_2D, yy + EPS_2D
    conics = torch.stack((yy / det, -xy / det, xx / det), dim=-1)

    opacities = gaussians.opacities[:, 0].sigmoid()
    if antialiased:
        opacities = opacities * _safe_sqrt(det_sharp / det)
    radii = _radii(means2d.detach(), xx.detach(), yy.detach(), det.detach(), depths.detach(), view)
    covs2d = torch.stack((xx, xy, yy), dim=-1).detach()
    return Splats(means2d.T, covs2d, conics, depths, radii, opacities)
