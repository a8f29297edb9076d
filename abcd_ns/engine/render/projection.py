"""Gaussians as one camera sees them: 3DGS's ellipsoids or 2DGS's discs, with the same parameters."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int, Real
from torch import Tensor

from abcd_ns.engine.gaussians.spherical_harmonics import BASES, MAX_SH_DEGREE
from abcd_ns.engine.render import splat_kernels
from abcd_ns.engine.render.splat_kernels import DEPTH
from abcd_ns.engine.types import Gaussians, View

PrimitiveName = Literal["3dgs", "2dgs"]
DRAWN_SIGMAS = 3.33
"""How far out a Gaussian is drawn, in standard deviations on screen. Fragments under alpha = 1/255 are
skipped, and opacity is at most 1, so exp(-d^2 / 2) >= 1/255: d <= sqrt(2 ln 255) = 3.3291."""


@dataclass(frozen=True)
class Primitive:
    """How Gaussians are projected. What they look like in a pixel is in `cpu/reference.py` and in gsplat."""

    name: PrimitiveName
    prefix: str
    """Of names that tell primitives apart."""
    project: Callable[[Tensor, Tensor], Tensor]
    """Parameters [p, n] and a camera [c] to rows [r, n], in torch; see Splats."""
    graded: int
    """Rows that take gradients: all but the last four."""
    center: int
    """The first of two such rows that say where on screen the middle is; residuals are summed about it."""
    axes: int
    """Along which it extends: those of its scales that are drawn."""
    blur_pixels: float
    """How far from its middle a point may be drawn, px."""

    @property
    def rows(self) -> int:
        """Of a Gaussian in one view, see Splats."""
        return self.graded + 4


SPLATS = Primitive(
    name="3dgs",
    prefix="",
    project=splat_kernels.splat,
    graded=splat_kernels.SPLAT_GRADED,
    center=splat_kernels.X,
    axes=3,
    blur_pixels=DRAWN_SIGMAS * math.sqrt(splat_kernels.EPS_2D),
)
SURFELS = Primitive(
    name="2dgs",
    prefix="surfel-",
    project=splat_kernels.surfel,
    graded=splat_kernels.SURFEL_GRADED,
    center=splat_kernels.U,
    axes=2,
    blur_pixels=DRAWN_SIGMAS * math.sqrt(0.5),
)
PRIMITIVES: dict[PrimitiveName, Primitive] = {each.name: each for each in (SPLATS, SURFELS)}


@dataclass(frozen=True)
class Splats:
    """N Gaussians as a rasterizer draws them. Pixels of the full image throughout."""

    planes: Float[Tensor, "r n"]
    """A row for each quantity: x, y, depth, some that give the shape, opacity, three of colour, four of
    bounds. See splat_kernels."""

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
    """Planes of each camera, see Splats and `camera_numbers`; differentiable in the Gaussians and cameras."""
    parts = [gaussians.means, gaussians.scales, gaussians.quats, gaussians.opacities, gaussians.features_dc]
    rest = gaussians.features_rest.flatten(1)
    parameters = torch.cat((*parts, F.pad(rest, (0, 3 * BASES - rest.shape[1]))), dim=1).T
    return torch.stack([primitive.project(parameters, camera) for camera in cameras])


def camera_numbers(view: View, like: Tensor, sh_degree: int, antialiased: bool) -> Float[Tensor, "c"]:
    """A view as `splat` takes it, in the dtype and on the device of `like`; one copy to the device."""
    learns = view.viewmat.requires_grad  # then each drawing has its own way back
    pinhole, center, near = (replace(view) if learns else view).numbers.tensor_split((18, 21))
    compensates, degrees = _options(sh_degree, antialiased, near.dtype, near.device)
    return torch.cat((pinhole, compensates, center, near, degrees)).to(like)


@lru_cache
def _options(sh_degree: int, antialiased: bool, dtype: torch.dtype, device: torch.device) -> list[Tensor]:
    degrees = [float(degree < sh_degree) for degree in range(MAX_SH_DEGREE)]
    return [torch.tensor(row, dtype=dtype, device=device) for row in ([float(antialiased)], degrees)]


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
    """
    low, high = means2d - radii[..., None], means2d + radii[..., None]
    visible = (radii > 0) & (high > 0).all(dim=-1)
    visible = (visible & (low[..., 0] < view.width) & (low[..., 1] < view.height))[..., None]
    if means2d.shape[-2] == 0:
        return torch.cat((low.new_full((2,), math.inf), low.new_full((2,), -math.inf)))
    low = torch.where(visible, low, math.inf).amin(dim=-2)
    return torch.cat((low, torch.where(visible, high, -math.inf).amax(dim=-2)), dim=-1)
