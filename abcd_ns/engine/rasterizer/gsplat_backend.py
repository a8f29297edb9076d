"""The gsplat rasterizer: gsplat 1.4.0's CUDA kernels, unmodified, with crops and frozen Gaussians.

Importing this module imports gsplat, which compiles its CUDA extension at the first call if need be.
"""

import weakref
from collections.abc import Sequence
from dataclasses import dataclass
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
from jaxtyping import Float, Int
from torch import Tensor

from abcd_ns.engine.rasterizer.base import Cut, DepthWindow, Raster, Rasterizer, Shot
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
from abcd_ns.engine.types import Crop, Gaussians, View

TILE = 16
"""gsplat's tile size, pixels."""
NO_WINDOW = 'The gsplat rasterizer has no z window; use ownership by means or the rasterizer "torch".'


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
    shifted = means2d - means2d.new_tensor([crop.x, crop.y])
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
    """gsplat 1.4.0 on CUDA, float32. Has no z window; the picture of a crop is that of the full image."""

    supports_z_window = False

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
        seen = _project(gaussians, view, sh_degree, antialiased)
        planes = gaussians.means.new_zeros((SPLAT_ROWS, len(gaussians)))  # covariances stay 0
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
        if any(shot.z_window is not None for shot in shots):
            raise ValueError(NO_WINDOW)
        rasters = [_draw_shot(gaussians, shot, sh_degree, antialiased, absgrad) for shot in shots]
        for raster in rasters:
            raster.info["n_cameras"] = len(shots)
        return tuple(rasters)

    def cut(self, *_args: Any, **_options: Any) -> Cut:
        """See Rasterizer.cut: stock gsplat cannot."""
        raise ValueError(NO_WINDOW)

    def depth_window(self, *_args: Any, **_options: Any) -> DepthWindow:
        """See Rasterizer.depth_window: stock gsplat cannot."""
        raise ValueError(NO_WINDOW)


def _draw_shot(gaussians: Gaussians, shot: Shot, sh_degree: int, antialiased: bool, absgrad: bool) -> Raster:
    view, crop, frozen = shot.view, shot.crop, shot.frozen
    if len(gaussians) + (0 if frozen is None else len(frozen)) == 0:
        return _nothing(gaussians, view, crop)
    own = _project(gaussians, view, sh_degree, antialiased)
    everyone = own if frozen is None or len(frozen) == 0 else _join(own, _projected(frozen))
    drawn = _aligned(crop)
    features, alphas = _draw(own, everyone, drawn, view, absgrad)
    rows, cols = Crop(crop.x - drawn.x, crop.y - drawn.y, crop.width, crop.height).slices
    features, alphas = features[rows, cols], alphas[rows, cols]
    return Raster(features[..., :3], 1.0 - alphas[..., 0], features[..., 3], _info(own, view))


def _projected(splats: Splats) -> _Projected:
    """In gsplat's shapes."""
    features = torch.cat((splats.colors, splats.depths[:, None]), dim=-1)
    values = (splats.radii, splats.means2d, splats.depths, splats.conics, splats.opacities, features)
    return _Projected(*(value[None].contiguous() for value in values))


def _draw(
    own: _Projected, everyone: _Projected, crop: Crop, view: View, absgrad: bool
) -> tuple[Tensor, Tensor]:
    """Second half of gsplat's `rasterization`: (features [h, w, 4], alphas [h, w, 1]) of an aligned crop."""
    means2d, radii = everyone.means2d, everyone.radii
    if crop != view.full:
        means2d, radii = _shift_into(crop, means2d, radii)
    tile_width, tile_height = -(-crop.width // TILE), -(-crop.height // TILE)
    _, isect_ids, flatten_ids = isect_tiles(means2d, radii, everyone.depths, TILE, tile_width, tile_height)
    means2d = means2d.contiguous()
    if absgrad and means2d.requires_grad and means2d is not own.means2d:
        _forward_absgrad(own.means2d, means2d)
    features, alphas = rasterize_to_pixels(
        means2d,
        everyone.conics,
        everyone.features,
        everyone.opacities,
        crop.width,
        crop.height,
        TILE,
        isect_offset_encode(isect_ids, 1, tile_width, tile_height),
        flatten_ids,
        absgrad=absgrad,
    )
    return features[0], alphas[0]


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
    """An empty drawing; gsplat is not asked."""
    means, opacities = gaussians.means, gaussians.opacities[:, 0][None]
    empty = _Projected(
        opacities.int(), means[None, :, :2], opacities, means[None], opacities, means.new_zeros((1, 0, 4))
    )
    color = means.new_zeros((crop.height, crop.width, 3))
    return Raster(color, torch.ones_like(color[..., 0]), torch.zeros_like(color[..., 0]), _info(empty, view))
