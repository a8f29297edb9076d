"""Gaussians as one camera sees them."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from abcd_ns.engine.rasterizer import splat_kernels as rows
from abcd_ns.engine.types import Gaussians, View


@dataclass(frozen=True)
class Splats:
    """N Gaussians as a rasterizer draws them. Pixels of the full image throughout."""

    planes: Float[Tensor, "r n"]
    """A row for each quantity, see splat_kernels."""

    def __len__(self) -> int:
        return self.planes.shape[1]

    @property
    def means2d(self) -> Float[Tensor, "n 2"]:
        """Centres (x, y)."""
        return self.planes[: rows.DEPTH].T

    @property
    def depths(self) -> Float[Tensor, "n"]:
        """Camera z of the 3D centres, world units."""
        return self.planes[rows.DEPTH]

    @property
    def conics(self) -> Float[Tensor, "n 3"]:
        """Inverses of the 2D covariances (xx, xy, yy), blur included."""
        return self.planes[rows.CONIC_XX : rows.OPACITY].T

    @property
    def opacities(self) -> Float[Tensor, "n"]:
        """After the sigmoid and, if antialiased, after compensation."""
        return self.planes[rows.OPACITY]

    @property
    def bases(self) -> Float[Tensor, "b n"]:
        """Spherical harmonics of degrees 1 to 3 in the direction from the camera."""
        return self.planes[rows.FIRST_BASIS : rows.GRADED]

    @property
    def radii(self) -> Int[Tensor, "n"]:
        """3 sigma along the longer axis, rounded up; 0 for what no pixel sees."""
        return self.planes[rows.RADIUS].detach().int()

    def __getitem__(self, index: Int[Tensor, "m"]) -> "Splats":
        """Those at `index`."""
        return Splats(self.planes.index_select(1, index))


class _BuiltSplat(torch.autograd.Function):
    """`splat` and its gradient from machine code; nothing but the inputs is kept in between."""

    @staticmethod
    def forward(
        ctx: Any, parameters: Float[Tensor, "p n"], camera: Float[Tensor, "c"]
    ) -> Float[Tensor, "r n"]:
        ctx.save_for_backward(parameters, camera)
        return rows.SPLAT(parameters, camera)[0]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Float[Tensor, "r n"]) -> tuple[Float[Tensor, "p n"], None]:
        graded = grad[: rows.GRADED].contiguous()
        return rows.SPLAT_BACKWARD(*ctx.saved_tensors, graded)[0], None


def camera_numbers(view: View, like: Tensor, antialiased: bool) -> Float[Tensor, "c"]:
    """A view as `splat` takes it, in the dtype and on the device of `like`."""
    viewmat, K = view.viewmat.to(like), view.K.to(like)
    rest = like.new_tensor([view.width, view.height, float(antialiased)])
    pinhole = (K[0, 0, None], K[1, 1, None], K[:2, 2])
    return torch.cat((viewmat[:3, :3].reshape(-1), viewmat[:3, 3], *pinhole, rest, view.center.to(like)))


def project(gaussians: Gaussians, view: View, *, antialiased: bool = False, built: bool = True) -> Splats:
    """Project Gaussians into a view; differentiable in the Gaussians, and in the pose if it takes gradients.

    Args:
        antialiased: multiply opacities by sqrt(det(cov) / det(cov + blur)), as in Mip-Splatting.
        built: use machine code where it is there.
    """
    columns = (gaussians.means, gaussians.scales, gaussians.quats, gaussians.opacities)
    parameters = torch.cat(columns, dim=1).T.contiguous()
    camera = camera_numbers(view, gaussians.means, antialiased)
    if not torch.is_grad_enabled() or not (parameters.requires_grad or camera.requires_grad):
        return Splats(rows.SPLAT(parameters, camera, built=built)[0])
    if built and not camera.requires_grad and rows.SPLAT.suits(parameters, camera):
        return Splats(_BuiltSplat.apply(parameters, camera))
    return Splats(rows.splat(parameters, camera)[0])
