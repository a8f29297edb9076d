"""Gaussians as one camera sees them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int, Real
from torch import Tensor

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
        planes = self.planes.clone()
        planes[-7:-4] = 0
        return Splats(planes)

    def __getitem__(self, index: Int[Tensor, "m"]) -> "Splats":
        """Those at `index`."""
        return Splats(self.planes.index_select(1, index))


def project_in_torch(
    gaussians: Gaussians, cameras: Sequence[Float[Tensor, "c"]], primitive: Primitive = SPLATS
) -> Float[Tensor, "v r n"]:
    """Planes of each camera, see Splats; differentiable in the Gaussians and in the cameras.

    Args:
        cameras: see `camera_numbers`.
    """
    parts = [gaussians.means, gaussians.scales, gaussians.quats, gaussians.opacities, gaussians.features_dc]
    rest = gaussians.features_rest.flatten(1)
    parameters = torch.cat((*parts, F.pad(rest, (0, 3 * BASES - rest.shape[1]))), dim=1).T
    return torch.stack([primitive.project(parameters, camera) for camera in cameras])


def camera_numbers(view: View, like: Tensor, sh_degree: int, antialiased: bool) -> Float[Tensor, "c"]:
    """A view as `splat` takes it, in the dtype and on the device of `like`; one copy to the device."""
    viewmat, K = view.viewmat, view.K
    options = viewmat.new_tensor([view.width, view.height, float(antialiased)])
    degrees = [float(degree < sh_degree) for degree in range(MAX_SH_DEGREE)]
    pinhole = (K[0, 0, None], K[1, 1, None], K[:2, 2])
    pose = (viewmat[:3, :3].reshape(-1), viewmat[:3, 3])
    rest = (options, view.center, viewmat.new_tensor([view.near, *degrees]))
    return torch.cat((*pose, *pinhole, *rest)).to(like)


def check_degree(gaussians: Gaussians, sh_degree: int) -> None:
    """Raise ValueError unless the Gaussians hold harmonics of `sh_degree`."""
    if not 0 <= sh_degree <= min(MAX_SH_DEGREE, gaussians.sh_degree):
        raise ValueError(
            f"sh_degree is {sh_degree}, but the Gaussians hold degrees up to {gaussians.sh_degree}, and "
            f"degrees above {MAX_SH_DEGREE} are not supported; lower sh_degree."
        )


def extents_of(
    means2d: Float[Tensor, "*c n 2"], radii: Real[Tensor, "*c n"], view: View
) -> Float[Tensor, "*c 4"]:
    """(left, top, right, bottom) of all that may be drawn in the image, px; infinite, the wrong way round,
    where nothing is.

    Args:
        means2d: centres in the full image, px.
        radii: half the sides of their squares, px; 0 where culled.
        view: gives the size of the image.
    """
    low, high = means2d - radii[..., None], means2d + radii[..., None]
    visible = (radii > 0) & (high > 0).all(dim=-1)
    visible = (visible & (low[..., 0] < view.width) & (low[..., 1] < view.height))[..., None]
    if means2d.shape[-2] == 0:
        return torch.cat((low.new_full((2,), math.inf), low.new_full((2,), -math.inf)))
    low = torch.where(visible, low, math.inf).amin(dim=-2)
    return torch.cat((low, torch.where(visible, high, -math.inf).amax(dim=-2)), dim=-1)
