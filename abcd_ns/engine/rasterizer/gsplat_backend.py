"""The gsplat rasterizer: gsplat 1.4.0's CUDA kernels, unmodified, with crops, frozen Gaussians and z windows.

gsplat draws from a sorted list of (tile, depth) keys, each with the Gaussian that it belongs to. Leaving out
those whose depth is not within the tile's window is all that a z window takes.

Importing this module imports gsplat, which compiles its CUDA extension at the first call if need be.
"""

import weakref
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import gsplat
import torch
from gsplat.cuda._wrapper import (
    fully_fused_projection,
    isect_offset_encode,
    isect_tiles,
    rasterize_to_pixels,
    spherical_harmonics,
)
from jaxtyping import Bool, Float, Int
from torch import Tensor

from abcd_ns.engine.rasterizer.base import Cut, Raster, Rasterizer, Shot
from abcd_ns.engine.rasterizer.projection import Splats, check_degree
from abcd_ns.engine.rasterizer.splat_kernels import (
    CONIC_XX,
    DEPTH,
    GRADED,
    OPACITY,
    RADIUS,
    RED,
    SPLAT_ROWS,
)
from abcd_ns.engine.rasterizer.tile_grid import TileGrid
from abcd_ns.engine.rasterizer.z_window import ZWindow, showing
from abcd_ns.engine.types import Crop, Gaussians, Layer, View

TILE = 16
"""gsplat's tile size, pixels."""


@dataclass(frozen=True)
class _Projected:
    """n Gaussians in one camera, in gsplat's shapes."""

    radii: Int[Tensor, "1 n"]
    means2d: Float[Tensor, "1 n 2"]
    depths: Float[Tensor, "1 n"]
    conics: Float[Tensor, "1 n 3"]
    opacities: Float[Tensor, "1 n"]
    features: Float[Tensor, "1 n 4"]
    """Colour, then depth: what is composited."""


@dataclass(frozen=True)
class _Pairs:
    """The (Gaussian, tile) pairs of a crop as gsplat sorts them: by tile, then by depth.

    Crops begin where a tile of the full image does, so their tiles are those of a TileGrid, in its order.
    """

    grid: TileGrid
    ids: Int[Tensor, "q"]
    """The keys: tile << 32 | bits of the depth."""
    gaussians: Int[Tensor, "q"]
    """Whose they are."""

    @property
    def tile(self) -> Int[Tensor, "q"]:
        """Number of each pair's tile."""
        return self.ids >> 32

    def __getitem__(self, keep: Bool[Tensor, "q"]) -> "_Pairs":
        """Some of them, in order."""
        kept = keep.nonzero()[:, 0]  # one wait, and not one for each list
        return _Pairs(self.grid, self.ids.index_select(0, kept), self.gaussians.index_select(0, kept))

    def offsets(self) -> Int[Tensor, "1 r c"]:
        """Where each tile's pairs begin."""
        return isect_offset_encode(self.ids, 1, self.grid.cols, self.grid.rows)


def _project(gaussians: Gaussians, view: View, sh_degree: int, antialiased: bool) -> _Projected:
    """The first half of gsplat's `rasterization(packed=False)`, for the full image."""
    viewmat, K = view.viewmat.to(gaussians.means), view.K.to(gaussians.means)
    radii, means2d, depths, conics, compensations = fully_fused_projection(
        gaussians.means,
        None,
        gaussians.quats,
        gaussians.scales.exp(),
        viewmat[None],
        K[None],
        view.width,
        view.height,
        near_plane=view.near,
        packed=False,
        calc_compensations=antialiased,
    )
    opacities = gaussians.opacities[:, 0].sigmoid()[None]
    if compensations is not None:
        opacities = opacities * compensations
    used = (sh_degree + 1) ** 2
    coefficients = torch.cat((gaussians.features_dc[:, None], gaussians.features_rest), dim=1)[:, :used]
    directions = gaussians.means - view.center.to(gaussians.means)
    colors = spherical_harmonics(sh_degree, directions[None], coefficients[None], masks=radii > 0)
    features = torch.cat((torch.clamp_min(colors + 0.5, 0.0), depths[..., None]), dim=-1)
    return _Projected(radii, means2d, depths, conics, opacities, features)


def _join(own: _Projected, frozen: _Projected) -> _Projected:
    pairs = ((getattr(own, name), getattr(frozen, name)) for name in _Projected.__dataclass_fields__)
    return _Projected(*(torch.cat(pair, dim=1) for pair in pairs))


def _aligned(crop: Crop) -> Crop:
    """The crop, grown up and left to gsplat's tiles: then its tiles are those of the full image."""
    x, y = crop.x - crop.x % TILE, crop.y - crop.y % TILE
    return Crop(x, y, crop.x + crop.width - x, crop.y + crop.height - y)


def _shift_into(crop: Crop, means2d: Tensor, radii: Tensor) -> tuple[Tensor, Tensor]:
    """Centres relative to the crop, and radii with 0 for what misses it.

    Shifting the principal point instead would change the picture: the projection's clamp depends on it.
    """
    shifted = means2d - means2d.new_tensor([crop.x, crop.y]) if crop.x or crop.y else means2d
    center = shifted.detach()
    size = center.new_tensor([crop.width, crop.height])
    # A tile's width of slack: gsplat draws on whole tiles, so a Gaussian beside the crop may still count.
    reach = radii[..., None] + TILE
    touches = ((center + reach > 0) & (center - reach < size)).all(dim=-1)
    return shifted, torch.where(touches, radii, torch.zeros_like(radii))


def _forward_absgrad(means2d: Tensor, drawn: Tensor) -> None:
    """Have gsplat's `absgrad`, which it leaves on the tensor it drew from, appear on `means2d` too.

    The hook holds `means2d` weakly, and `means2d` holds `drawn`: otherwise the graph would hold itself.
    """
    means2d.drawn_from = drawn
    reference = weakref.ref(means2d)

    def copy(_: Tensor) -> None:
        target = reference()
        if target is not None:
            target.absgrad = target.drawn_from.absgrad[:, : target.shape[1]]

    means2d.register_hook(copy)


class GsplatRasterizer(Rasterizer):
    """gsplat 1.4.0 on CUDA, float32. The picture of a crop is that of the full image."""

    window_side = TILE

    def __init__(self) -> None:
        self.name = f"gsplat-{gsplat.__version__}"

    def warm_up(self) -> None:
        """Nothing: gsplat compiles when it is imported, at the latest for the self-check."""

    @torch.no_grad()
    def project(
        self, gaussians: Gaussians, view: View, *, sh_degree: int = 0, antialiased: bool = False
    ) -> Splats:
        """See Rasterizer.project."""
        check_degree(gaussians, sh_degree)
        planes = gaussians.means.new_zeros((SPLAT_ROWS, len(gaussians)))  # covariances stay 0
        if len(gaussians) == 0:
            return Splats(planes)
        seen = _project(gaussians, view, sh_degree, antialiased)
        planes[:DEPTH], planes[DEPTH] = seen.means2d[0].T, seen.depths[0]
        planes[CONIC_XX:OPACITY], planes[OPACITY] = seen.conics[0].T, seen.opacities[0]
        planes[RED:GRADED], planes[RADIUS] = seen.features[0, :, :3].T, seen.radii[0]
        return Splats(planes)

    def draw(
        self,
        gaussians: Gaussians,
        shots: Sequence[Shot],
        *,
        sh_degree: int,
        antialiased: bool = False,
        absgrad: bool = False,
    ) -> tuple[Raster, ...]:
        """See Rasterizer.draw. One call of gsplat for each shot."""
        check_degree(gaussians, sh_degree)
        rasters = [_draw_shot(gaussians, shot, sh_degree, antialiased, absgrad) for shot in shots]
        for raster in rasters:
            raster.info["n_cameras"] = len(shots)
        return tuple(rasters)

    @torch.no_grad()
    def cut(
        self,
        gaussians: Gaussians,
        view: View,
        *,
        front: ZWindow,
        inside: ZWindow,
        back: ZWindow,
        crop: Crop,
        sh_degree: int,
        antialiased: bool = False,
    ) -> Cut:
        """See Rasterizer.cut. Projected and sorted once."""
        splats = self.project(gaussians, view, sh_degree=sh_degree, antialiased=antialiased)
        drawing = _Drawing.of(_projected(splats), crop)
        members = drawing.within(inside).pairs.gaussians.unique().long()
        layers = (drawing.within(window).layer() for window in (front, back))
        return Cut(*layers, splats[members], members)

    @torch.no_grad()
    def depth_window(
        self, gaussians: Gaussians, view: View, *, crop: Crop, visible: float, antialiased: bool = False
    ) -> ZWindow:
        """See Rasterizer.depth_window."""
        drawing = _Drawing.of(_projected(self.project(gaussians, view, antialiased=antialiased)), crop)
        return showing(drawing.pairs.grid, drawing.pairs.tile, drawing.z, drawing.weights(), visible)


def _draw_shot(gaussians: Gaussians, shot: Shot, sh_degree: int, antialiased: bool, absgrad: bool) -> Raster:
    view, crop, frozen = shot.view, shot.crop, shot.frozen
    if len(gaussians) + (0 if frozen is None else len(frozen)) == 0:
        return _nothing(gaussians, view, crop)
    own = _project(gaussians, view, sh_degree, antialiased)
    everyone = own if frozen is None or len(frozen) == 0 else _join(own, _projected(frozen))
    drawing = _Drawing.of(everyone, crop)
    if shot.z_window is not None:
        drawing = drawing.within(shot.z_window, always=0 if frozen is None else len(gaussians))
    if absgrad and own.means2d.requires_grad and drawing.means2d is not own.means2d:
        _forward_absgrad(own.means2d, drawing.means2d)
    features, transmittance = drawing.draw(absgrad)
    return Raster(features[..., :3], transmittance, features[..., 3], _info(own, view))


def _projected(splats: Splats) -> _Projected:
    """In gsplat's shapes."""
    features = torch.cat((splats.colors, splats.depths[:, None]), dim=-1)
    values = (splats.radii, splats.means2d, splats.depths, splats.conics, splats.opacities, features)
    return _Projected(*(value[None].contiguous() for value in values))


@dataclass(frozen=True)
class _Drawing:
    """Second half of gsplat's `rasterization`, for the tiles of a crop."""

    everyone: _Projected
    means2d: Float[Tensor, "1 n 2"]
    """Relative to the upper left tile."""
    crop: Crop
    pairs: _Pairs

    @staticmethod
    def of(everyone: _Projected, crop: Crop) -> "_Drawing":
        """What may be drawn in a crop."""
        grid, tiled = TileGrid(crop, TILE), _aligned(crop)
        means2d, radii = _shift_into(tiled, everyone.means2d, everyone.radii)
        means2d = means2d.contiguous()
        if means2d.shape[1] == 0:
            nothing = radii.new_zeros(0)
            return _Drawing(everyone, means2d, crop, _Pairs(grid, nothing.long(), nothing))
        _, ids, gaussians = isect_tiles(means2d, radii, everyone.depths, TILE, grid.cols, grid.rows)
        return _Drawing(everyone, means2d, crop, _Pairs(grid, ids, gaussians))

    @property
    def z(self) -> Float[Tensor, "q"]:
        """Camera z of each pair's Gaussian."""
        return self.everyone.depths[0].index_select(0, self.pairs.gaussians)

    def within(self, window: ZWindow, always: int = 0) -> "_Drawing":
        """Without the pairs that lie outside of their tile's window.

        Args:
            always: the first so many Gaussians are not masked.
        """
        inside = window.on(self.pairs.grid).holds(self.pairs.tile, self.z)
        if always:
            inside |= self.pairs.gaussians < always
        return replace(self, pairs=self.pairs[inside])

    def draw(self, absgrad: bool = False) -> tuple[Float[Tensor, "h w 4"], Float[Tensor, "h w"]]:
        """(features, transmittance) of the crop."""
        everyone, crop = self.everyone, self.crop
        tiled = _aligned(crop)
        features, alphas = rasterize_to_pixels(
            self.means2d,
            everyone.conics,
            everyone.features,
            everyone.opacities,
            tiled.width,
            tiled.height,
            TILE,
            self.pairs.offsets(),
            self.pairs.gaussians,
            absgrad=absgrad,
        )
        rows, cols = Crop(crop.x - tiled.x, crop.y - tiled.y, crop.width, crop.height).slices
        return features[0, rows, cols], 1.0 - alphas[0, rows, cols, 0]

    def layer(self) -> Layer:
        """What it looks like."""
        features, transmittance = self.draw()
        return Layer(features[..., :3], transmittance)

    def weights(self) -> Float[Tensor, "q"]:
        """For each pair the sum of the Gaussian's weight alpha T over the tile's pixels in the crop.

        Each pair is drawn as if it were a Gaussian of its own: the gradient of the picture's sum by its
        colour, of which one channel will do, is its weight.
        """
        owner, everyone = self.pairs.gaussians, self.everyone
        if len(owner) == 0:
            return self.z
        parts = (self.means2d, everyone.conics, everyone.opacities)
        means2d, conics, opacities = (part.index_select(1, owner) for part in parts)
        dark = means2d.new_zeros((1, len(owner), 1)).requires_grad_()
        tiled, offsets = _aligned(self.crop), self.pairs.offsets()
        each = torch.arange(len(owner), device=owner.device, dtype=owner.dtype)
        with torch.enable_grad():
            picture, _ = rasterize_to_pixels(
                means2d, conics, dark, opacities, tiled.width, tiled.height, TILE, offsets, each
            )
            rows = slice(self.crop.y - tiled.y, None)
            cols = slice(self.crop.x - tiled.x, None)
            (found,) = torch.autograd.grad(picture[0, rows, cols].sum(), dark)
        return found[0, :, 0]


def _info(own: _Projected, view: View) -> dict[str, Any]:
    names = ("means2d", "radii", "depths", "conics", "opacities")
    info: dict[str, Any] = {name: getattr(own, name) for name in names}
    return info | {
        "width": view.width,
        "height": view.height,
        "n_cameras": 1,
        "camera_ids": None,
        "gaussian_ids": None,
    }


def _nothing(gaussians: Gaussians, view: View, crop: Crop) -> Raster:
    """An empty drawing; gsplat is not asked. In the graph like any other, so that a loss has a gradient."""
    means, opacities = gaussians.means, gaussians.opacities[:, 0][None]
    empty = _Projected(
        opacities.int(), means[None, :, :2], opacities, means[None], opacities, means.new_zeros((1, 0, 4))
    )
    zero = empty.means2d.sum()
    color = zero.expand(crop.height, crop.width, 3)
    return Raster(color, 1.0 - color[..., 0], color[..., 0], _info(empty, view))
