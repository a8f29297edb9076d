"""Gaussians as one camera sees them."""

from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from abcd_ns.engine.gaussians.spherical_harmonics import BASES, MAX_SH_DEGREE
from abcd_ns.engine.render.primitive import SPLATS, Primitive
from abcd_ns.engine.render.splat_kernels import DEPTH
from abcd_ns.engine.types import Gaussians, View


@dataclass(frozen=True)
class Splats:
    """N Gaussians as a rasterizer draws them. Pixels of the full image throughout."""

    planes: Float[Tensor, "r n"]
    """A row for each quantity: x, y, depth, some that give the shape, opacity, three of colour, four of
    bounds. See splat_kernels and surfel_kernels."""

    def __len__(self) -> int:
        return self.planes.shape[1]

    @property
    def means2d(self) -> Float[Tensor, "n 2"]:
        """Middles (x, y) of what may be drawn."""
        return self.planes[:DEPTH].T

    @property
    def depths(self) -> Float[Tensor, "n"]:
        """Camera z of the 3D centres, world units."""
        return self.planes[DEPTH]

    @property
    def shapes(self) -> Float[Tensor, "n s"]:
        """How they spread: of Gaussians inverses of the 2D covariances (xx, xy, yy), blur included."""
        return self.planes[DEPTH + 1 : -8].T

    @property
    def opacities(self) -> Float[Tensor, "n"]:
        """After the sigmoid and, if antialiased, after compensation."""
        return self.planes[-8]

    @property
    def colors(self) -> Float[Tensor, "n 3"]:
        """As this camera sees them: linear, 0 or more, may exceed 1."""
        return self.planes[-7:-4].T

    @property
    def radii(self) -> Int[Tensor, "n"]:
        """3 sigma along the longer axis, rounded up; 0 for what no pixel sees."""
        return self.planes[-1].detach().int()

    @property
    def black(self) -> "Splats":
        """The same, which hide what they hid, and show nothing."""
        return self.colored(torch.zeros_like(self.colors))

    def colored(self, colors: Float[Tensor, "n 3"]) -> "Splats":
        """The same in other colours."""
        planes = self.planes.clone()
        planes[-7:-4] = colors.T
        return Splats(planes)

    def __getitem__(self, index: Int[Tensor, "m"]) -> "Splats":
        """Those at `index`."""
        return Splats(self.planes.index_select(1, index))


class _Splat(torch.autograd.Function):
    """`Primitive.project` and its gradient by the Gaussians; nothing but the inputs is kept in between."""

    @staticmethod
    def forward(
        ctx: Any,
        parameters: Float[Tensor, "p n"],
        camera: Float[Tensor, "c"],
        primitive: Primitive,
        built: bool,
    ) -> Float[Tensor, "r n"]:
        ctx.save_for_backward(parameters, camera)
        ctx.primitive, ctx.built = primitive, built
        return primitive.project(parameters, camera, built=built)[0]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Float[Tensor, "r n"]) -> tuple[Float[Tensor, "p n"], None, None, None]:
        graded = grad[: ctx.primitive.graded].contiguous()
        back = ctx.primitive.project_backward(*ctx.saved_tensors, graded, built=ctx.built)
        return back[0], None, None, None


def pack(gaussians: Gaussians) -> Float[Tensor, "p n"]:
    """Gaussians as `splat` takes them; worth keeping where many views look at the same ones."""
    parts = [gaussians.means, gaussians.scales, gaussians.quats, gaussians.opacities, gaussians.features_dc]
    rest = gaussians.features_rest.flatten(1)
    missing = 3 * BASES - rest.shape[1]
    return torch.cat((*parts, F.pad(rest, (0, missing)) if missing else rest), dim=1).T.contiguous()


def camera_numbers(view: View, like: Tensor, sh_degree: int, antialiased: bool) -> Float[Tensor, "c"]:
    """A view as `splat` takes it, in the dtype and on the device of `like`; one copy to the device."""
    viewmat, K = view.viewmat, view.K
    options = viewmat.new_tensor([view.width, view.height, float(antialiased)])
    degrees = [float(degree < sh_degree) for degree in range(MAX_SH_DEGREE)]
    pinhole = (K[0, 0, None], K[1, 1, None], K[:2, 2])
    pose = (viewmat[:3, :3].reshape(-1), viewmat[:3, 3])
    rest = (options, view.center, viewmat.new_tensor([view.near, *degrees]))
    return torch.cat((*pose, *pinhole, *rest)).to(like)


def project_packed(
    parameters: Float[Tensor, "p n"],
    view: View,
    *,
    sh_degree: int = 0,
    antialiased: bool = False,
    built: bool = True,
    primitive: Primitive = SPLATS,
) -> Splats:
    """Project Gaussians into a view; differentiable in the Gaussians, and in the pose if it takes gradients.

    Args:
        parameters: see `pack`.
        sh_degree: the degree of spherical harmonics in use.
        antialiased: multiply opacities by sqrt(det(cov) / det(cov + blur)), as in Mip-Splatting.
        built: use machine code where it is there.
        primitive: what a Gaussian is.
    """
    camera = camera_numbers(view, parameters, sh_degree, antialiased)
    if camera.requires_grad and torch.is_grad_enabled():
        return Splats(primitive.project.function(parameters, camera)[0])
    return Splats(_Splat.apply(parameters, camera, primitive, built))


def check_degree(gaussians: Gaussians, sh_degree: int) -> None:
    """Raise ValueError unless the Gaussians hold harmonics of `sh_degree`."""
    if not 0 <= sh_degree <= min(MAX_SH_DEGREE, gaussians.sh_degree):
        raise ValueError(
            f"sh_degree is {sh_degree}, but the Gaussians hold degrees up to {gaussians.sh_degree}, and "
            f"degrees above {MAX_SH_DEGREE} are not supported; lower sh_degree."
        )
