"""The gsplat rasterizer: gsplat 1.4.0's CUDA kernels, unmodified, with crops, frozen Gaussians and z windows.

Importing this module imports gsplat, which compiles its CUDA extension at the first call if need be.
"""

from collections.abc import Iterator, Sequence
from functools import partial
from itertools import groupby
from typing import Any

import gsplat
import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.render.base import AnyShot, Cut, CutShot, Raster, Rasterizer, ResidualSums, Shot, runs
from abcd_ns.engine.render.cuda.drawn import Drawn
from abcd_ns.engine.render.cuda.pairs import TILE, Drawing, FlatSplats
from abcd_ns.engine.render.cuda.projection import kind_of, place_on_screen, project
from abcd_ns.engine.render.projection import PRIMITIVES, PrimitiveName, Splats, extents_of
from abcd_ns.engine.render.z_window import ZWindow
from abcd_ns.engine.types import Gaussians, View

FOOTPRINT_BYTES = 256 << 20
"""Of what is projected into several views at once, to see where they see it."""
BYTES_PER_FOOTPRINT = 100
"""Of a Gaussian in a view meanwhile."""


class GsplatRasterizer(Rasterizer):
    """gsplat 1.4.0 on CUDA, float32. The picture of a crop is that of the full image."""

    tile_side = TILE

    def __init__(self, primitive: PrimitiveName = "3dgs") -> None:
        self.primitive, self._kind = PRIMITIVES[primitive], kind_of(primitive)
        self.name = f"{self.primitive.prefix}gsplat-{gsplat.__version__}"

    @torch.no_grad()
    def project(
        self, gaussians: Gaussians, view: View, *, sh_degree: int = 0, antialiased: bool = False
    ) -> Splats:
        return project(self._kind, gaussians, [view], sh_degree, antialiased).splats(0)

    @torch.no_grad()
    def extents(self, gaussians: Gaussians, views: Sequence[View]) -> Float[Tensor, "v 4"]:
        """See Rasterizer.extents. Views are projected together, and all that is found is copied at once."""
        if len(gaussians) == 0:
            return super().extents(gaussians, views)
        most = max(FOOTPRINT_BYTES // (BYTES_PER_FOOTPRINT * len(gaussians)), 1)
        found: list[Tensor] = [torch.empty(0)] * len(views)
        for places in _alike([_size(view) for view in views]):
            for k in range(0, len(places), most):
                part = places[k : k + most]
                seen = [views[place] for place in part]
                (radii, means2d, *_), _ = place_on_screen(self._kind, gaussians, seen)
                for place, extent in zip(part, extents_of(means2d, radii, seen[0]), strict=True):
                    found[place] = extent
        return torch.stack(found).cpu()

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
        """See Rasterizer.draw. One call of gsplat for all shots whose images are of one size."""
        rasters: dict[int, Raster] = {}
        # Windows mask what is frozen, or the Gaussians: no list has both.
        kinds = [(_size(shot.view), shot.frozen is None) for shot in shots]
        for places in _alike(kinds):
            alike = [shots[k] for k in places]
            drawn = self._draw_alike(gaussians, alike, sh_degree, antialiased, blend_weights, residual_sums)
            rasters.update(zip(places, drawn, strict=True))
        return tuple(rasters[k] for k in range(len(shots)))

    @torch.no_grad()
    def cuts(
        self, gaussians: Gaussians, shots: Sequence[CutShot], *, sh_degree: int, antialiased: bool = False
    ) -> Iterator[Cut]:
        """See Rasterizer.cuts. Each view is projected and sorted once, and a few are drawn in one pass."""
        for few in _a_few(shots, gaussians):
            views, crops = [shot.view for shot in few], [shot.crop for shot in few]
            seen = project(self._kind, gaussians, views, sh_degree, antialiased)
            drawing = Drawing.of(self._kind, FlatSplats.of(seen), crops, windowed=True)
            kept_ids = drawing.kept_ids(drawing.inside([shot.inside for shot in few]))
            fronts, backs = [shot.front for shot in few], [shot.back for shot in few]
            layers = (drawing.windowed(windows).layers() for windows in (fronts, backs))
            for k, (front, back, which) in enumerate(zip(*layers, kept_ids, strict=True)):
                yield Cut(front, back, seen.splats(k, which), which)

    @torch.no_grad()
    def depth_windows(
        self, gaussians: Gaussians, shots: Sequence[Shot], *, visible: float, antialiased: bool = False
    ) -> Iterator[ZWindow]:
        for few in _a_few(shots, gaussians):
            projected = project(self._kind, gaussians, [shot.view for shot in few], 0, antialiased)
            drawing = Drawing.of(self._kind, FlatSplats.of(projected), [shot.crop for shot in few])
            yield from drawing.windows(visible)

    def _draw_alike(
        self,
        gaussians: Gaussians,
        shots: Sequence[Shot],
        sh_degree: int,
        antialiased: bool,
        blend_weights: bool,
        residual_sums: bool,
    ) -> list[Raster]:
        views, crops = [shot.view for shot in shots], [shot.crop for shot in shots]
        frozen = [(k, shot.frozen) for k, shot in enumerate(shots) if shot.frozen]
        own = project(self._kind, gaussians, views, sh_degree, antialiased, blend_weights)
        info: dict[str, Any] = {"means2d": own.centers, "radii": own.radii}
        info |= {"weights": own.weights} if blend_weights else {}
        if len(gaussians) == 0 and not frozen:  # gsplat is not asked
            colors = [own.centers.sum().expand(crop.height, crop.width, 3) for crop in crops]
            return [Raster(color, 1.0 - color[..., 0], color[..., 0], info) for color in colors]
        everyone = FlatSplats.of(own, frozen, blend_weights)
        windows = [shot.z_window for shot in shots]
        windowed = any(window is not None for window in windows)
        drawing = Drawing.of(self._kind, everyone, crops, windowed=windowed)
        if windowed:
            always = 0 if shots[0].frozen is None else own.radii.numel()
            drawing = drawing.windowed(windows, always)
        if residual_sums:
            info["sums"] = ResidualSums(partial(drawing.residual_sums, own.centers.detach()))
        sheet = drawing.rasterized()
        return [Drawn(*sheet, k, part, info) for k, part in enumerate(drawing.parts)]


def _a_few(shots: Sequence[AnyShot], gaussians: Gaussians) -> Iterator[list[AnyShot]]:
    for _, alike in groupby(shots, lambda shot: _size(shot.view)):
        yield from runs(list(alike), gaussians=len(gaussians), padded=True)


def _size(view: View) -> tuple[int, int, float]:
    """What views have in common that gsplat draws in one call."""
    return view.width, view.height, view.near


def _alike(kinds: Sequence[object]) -> list[list[int]]:
    """Places of equal kinds."""
    return [[k for k, each in enumerate(kinds) if each == kind] for kind in dict.fromkeys(kinds)]
