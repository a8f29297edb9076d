"""What a Gaussian may be: 3DGS's ellipsoid or 2DGS's disc, with the same parameters."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from torch import Tensor

from abcd_ns.engine.render import splat_kernels, surfel_kernels

PrimitiveName = Literal["3dgs", "2dgs"]
DRAWN_SIGMAS = 3.33
"""How far out a Gaussian is drawn, in standard deviations on screen. Fragments under alpha = 1/255 are
skipped, and opacity is at most 1, so exp(-d^2 / 2) >= 1/255: d <= sqrt(2 ln 255) = 3.3291."""


@dataclass(frozen=True)
class Primitive:
    """How Gaussians are projected, and which tiles may draw them.

    What they look like in a pixel is `Fragments` on the CPU, and `cuda.kinds` on CUDA.
    """

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
    graded=splat_kernels.GRADED,
    center=splat_kernels.X,
    axes=3,
    blur_pixels=DRAWN_SIGMAS * math.sqrt(splat_kernels.EPS_2D),
)
SURFELS = Primitive(
    name="2dgs",
    prefix="surfel-",
    project=surfel_kernels.surfel,
    graded=surfel_kernels.GRADED,
    center=surfel_kernels.U,
    axes=2,
    blur_pixels=DRAWN_SIGMAS * math.sqrt(0.5),
)
PRIMITIVES: dict[PrimitiveName, Primitive] = {each.name: each for each in (SPLATS, SURFELS)}
