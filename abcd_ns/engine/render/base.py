"""What every rasterizer takes and gives."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from abcd_ns.engine.render.projection import Primitive, Splats, extents_of
from abcd_ns.engine.render.z_window import TileGrid, ZWindow
from abcd_ns.engine.types import Crop, Gaussians, Layer, View

DEVICE_PIXELS, DEVICE_SPLATS = 1 << 21, 400_000
"""Of the views that an accelerator draws together, at most, unless a single view has more."""
SUMS = 10
"""Of a Gaussian in a picture, see ResidualSums."""


@dataclass(frozen=True)
class Raster:
    """One drawing: the pixels of a crop."""

    color: Float[Tensor, "h w 3"]
    """Premultiplied colour, no background."""
    transmittance: Float[Tensor, "h w"]
    depth: Float[Tensor, "h w"]
    """Sum of weight x camera z. Expected depth is depth / (1 - transmittance)."""
    info: dict[str, Any]
    """Of the Gaussians that take gradients, from v cameras: means2d [v, n, 2] and radii [v, n], px of the
    full image, not of the crop. And `weights` and `sums`, where asked for."""

    @property
    def layer(self) -> Layer:
        return Layer(self.color, self.transmittance)


class Surroundings(NamedTuple):
    """What a drawn crop is shown in: two layers or none, a background, and what a pixel weighs."""

    front: Layer | None
    back: Layer | None
    background: Float[Tensor, "3"]
    counts: float
    """The gradient by the depth of a pixel that nothing hides, whatever the loss."""


Shown = tuple[tuple[slice, slice], Surroundings]
"""Rows and columns of a crop in what gsplat has drawn, and its surroundings."""


@dataclass(frozen=True)
class Shot:
    """One picture to draw."""

    view: View
    crop: Crop
    """Draw only these pixels of the image. The result equals the crop of the full drawing exactly."""
    frozen: Splats | None = None
    """What occludes and is occluded, without gradients: projected into `view` by the same rasterizer."""
    z_window: ZWindow | None = None
    """Masks the fragments of `frozen` where it is given, else those of the Gaussians; of this crop."""


@dataclass(frozen=True)
class CutShot:
    """One picture to cut: its pixels, and the windows that its fragments are parted by."""

    view: View
    crop: Crop
    front: ZWindow
    inside: ZWindow
    back: ZWindow


AnyShot = TypeVar("AnyShot", Shot, CutShot)


@dataclass(frozen=True)
class Cut:
    """Gaussians as one view sees them, cut by windows."""

    front: Layer
    back: Layer
    inside: Splats
    """Those that have any fragment in the middle, in the Gaussians' order."""
    kept_ids: Int[Tensor, "m"]
    """Which of the Gaussians they are."""


class ResidualSums:
    """For each Gaussian of a drawing the sums over pixels of w f, w r, w r x and w r y.

    There w = alpha T is its weight, r the residual by channel, f how much the pixel counts, and (x, y) the
    pixel's middle less the Gaussian's, px. `find` gives them for residuals, or is None where they come
    with the drawing's gradients.
    """

    def __init__(self, find: Callable[[Sequence[Tensor]], Float[Tensor, "v n 10"]] | None = None) -> None:
        self.values: Float[Tensor, "v n 10"] | None = None
        """After the drawing's backward pass; None where nobody has asked."""
        self.asked: list[Tensor] | None = None
        """The residuals that the backward pass is to sum up."""
        self._find = find  # which holds on to all that was drawn

    def ask(self, residuals: Sequence[Float[Tensor, "_h _w 4"]]) -> None:
        """Call before the backward pass, with r and then f of each picture."""
        if self._find is None:
            self.asked = [residual.contiguous() for residual in residuals]
        else:
            self.values, self._find = self._find(residuals), None


def moments(residual: Float[Tensor, "h w 4"], crop: Crop) -> Float[Tensor, "h w 10"]:
    """f, r, r x and r y of each pixel, with x and y in the image."""
    r, f = residual[..., :3], residual[..., 3:]
    x = torch.arange(crop.width, device=r.device, dtype=r.dtype)[:, None] + (crop.x + 0.5)
    y = torch.arange(crop.height, device=r.device, dtype=r.dtype)[:, None, None] + (crop.y + 0.5)
    return torch.cat((f, r, r * x, r * y), dim=-1)


def about(sums: Float[Tensor, "*n 10"], middle: Float[Tensor, "*n 2"]) -> Float[Tensor, "*n 10"]:
    """Sums of `moments`, with x and y counted from the Gaussians' middles."""
    f, r, x, y = sums.split((1, 3, 3, 3), dim=-1)
    middle = torch.where(f == 0, 0.0, middle)  # gsplat gives none of who is not drawn
    return torch.cat((f, r, x - middle[..., :1] * r, y - middle[..., 1:] * r), dim=-1)


class Rasterizer:
    """Draws Gaussians as gsplat 1.4.0's `rasterization` does for one pinhole camera; backends derive from it.

    Constants (alpha >= 1/255, alpha <= 0.999, stop at T <= 1e-4, 3 sigma radius, 0.3 px blur) are gsplat's.
    """

    name: str
    """Of primitive, backend and version, in messages."""
    primitive: Primitive
    """What a Gaussian is."""
    tile_side: int
    """Side of the tiles that z windows are given by, px."""

    @property
    def slack(self) -> float:
        """How far beyond its own size a Gaussian may count on screen, px: blur, half a tile's diagonal."""
        return self.primitive.blur_pixels + self.tile_side / math.sqrt(2)

    def window_grid(self, crop: Crop) -> TileGrid:
        """The tiles of a crop that its z windows are given by."""
        return TileGrid(crop, self.tile_side)

    def warm_up(self) -> None:
        """Do now, before a clock runs, what would otherwise be done on first use or not at all: compile."""

    def project(
        self, gaussians: Gaussians, view: View, *, sh_degree: int = 0, antialiased: bool = False
    ) -> Splats:
        """What a view sees of Gaussians that take no gradients, to be looked at or given to shots as frozen.

        Raises:
            ValueError: `sh_degree` is above what the Gaussians hold.
        """

    def extents(self, gaussians: Gaussians, views: Sequence[View]) -> Float[Tensor, "v 4"]:
        """Where in each view's image Gaussians may be drawn, on the CPU; see `extents_of`."""
        seen = ((self.project(gaussians, view), view) for view in views)
        return torch.stack([extents_of(splats.means2d, splats.radii, view) for splats, view in seen]).cpu()

    def draw(
        self,
        gaussians: Gaussians,
        shots: Sequence[Shot],
        *,
        sh_degree: int,
        antialiased: bool = False,
        blend_weights: bool = False,
        residual_sums: bool = False,
    ) -> tuple[Raster, ...]:
        """Draw `gaussians` for each shot, sorted by depth with what is frozen there.

        Args:
            gaussians: take gradients where their tensors require them; `info` is about these alone. Several
                rasters may share one `info`, of that many cameras.
            sh_degree: the degree of spherical harmonics in use; at most `gaussians.sh_degree`.
            antialiased: scale opacities by gsplat's compensation factor; of surfels it has none.
            blend_weights: give zeros for depths, from a leaf `info["weights"]` [v, n] that every Gaussian's
                depth is taken from: after backward its gradient is the sum of the Gaussian's weights alpha T,
                each times the gradient of the pixel's depth; and that changes no other gradient.
            residual_sums: take residuals, by `info["sums"]`: ResidualSums.

        Raises:
            ValueError: a window is of another crop, or of tiles that are no multiples of the rasterizer's; or
                `sh_degree` is above what the Gaussians hold.
        """

    def __call__(
        self, gaussians: Gaussians, view: View, *, crop: Crop | None = None, **options: Any
    ) -> Raster:
        """`draw`, with its options, for a single view and, without `crop`, all of its image."""
        return self.draw(gaussians, [Shot(view, crop or view.full)], **options)[0]

    def cuts(
        self, gaussians: Gaussians, shots: Sequence[CutShot], *, sh_degree: int, antialiased: bool = False
    ) -> Iterator[Cut]:
        """For each shot the fragments in two windows as layers, and what has fragments in a third; no
        gradients. Drawn as they are asked for, a few at a time."""

    def depth_windows(
        self, gaussians: Gaussians, shots: Sequence[Shot], *, visible: float, antialiased: bool = False
    ) -> Iterator[ZWindow]:
        """For each shot's crop the range of camera z, in each of its tiles, in which the Gaussians show, with
        nothing else in the scene; no gradients. See z_window.showing."""


def runs(
    shots: Sequence[AnyShot],
    pixels: int = DEVICE_PIXELS,
    *,
    gaussians: int = 0,
    splats: int = DEVICE_SPLATS,
    padded: bool = False,
) -> Iterator[list[AnyShot]]:
    """The shots in runs of neighbours.

    Args:
        pixels: most of a run of more than one.
        gaussians: that are drawn in each shot, if they are limited, too.
        splats: most of these in a run of more than one.
        padded: each crop is drawn as large as the largest of its run.
    """
    run: list[AnyShot] = []
    for shot in shots:
        crops = [each.crop for each in (*run, shot)]
        drawn = sum(crop.pixels for crop in crops)
        if padded:
            drawn = len(crops) * max(crop.width for crop in crops) * max(crop.height for crop in crops)
        if run and (drawn > pixels or len(crops) * gaussians > splats):
            yield run
            run = []
        run.append(shot)
    if run:
        yield run
