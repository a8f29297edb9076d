"""The torch rasterizer: gsplat's drawing for any device, by the native library on a CPU."""

from collections.abc import Iterator, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.kernels.native import library, suits
from abcd_ns.engine.render.base import AnyShot, Cut, CutShot, Raster, Rasterizer, Shot, runs
from abcd_ns.engine.render.cpu import native, reference
from abcd_ns.engine.render.projection import (
    PRIMITIVES,
    PrimitiveName,
    Splats,
    camera_numbers,
    check_degree,
    project_in_torch,
)
from abcd_ns.engine.render.splat_kernels import DEPTH
from abcd_ns.engine.render.z_window import ZWindow
from abcd_ns.engine.types import Crop, Gaussians, Layer, View

PIXELS_AT_ONCE, SPLATS_AT_ONCE = 1 << 17, 200_000
"""Of the views that layers are drawn for in one pass, at most: for a few pixels or Gaussians calls cost more
than what they compute."""
NO_ABSGRAD = "absgrad=True is not supported here: it takes 3dgs in float32 on a CPU, and a C++ compiler."


class TorchRasterizer(Rasterizer):
    """gsplat 1.4.0's `rasterization(packed=False)` or `rasterization_2dgs`: same picture, same gradient.

    Float32 on a CPU is drawn by the native library (see kernels), all else in plain torch: 20 times slower,
    the reference. Both are deterministic, whatever the number of threads, and agree to rounding.

    Args:
        use_native: False draws everything in torch.
        tile_side: pixels along a tile's side; a divisor of 16. The native library has 4.
    """

    def __init__(
        self, *, use_native: bool = True, tile_side: int = native.SIDE, primitive: PrimitiveName = "3dgs"
    ) -> None:
        self.primitive = PRIMITIVES[primitive]
        self.name = f"{self.primitive.prefix}torch-4"
        self.tile_side = tile_side
        self._use_native = use_native and tile_side == native.SIDE

    def warm_up(self) -> None:
        """See Rasterizer.warm_up. The library's threads take the place of torch's, see share_cores."""
        if self._use_native and library() is not None:
            torch.set_num_threads(1)

    @torch.no_grad()
    def project(
        self, gaussians: Gaussians, view: View, *, sh_degree: int = 0, antialiased: bool = False
    ) -> Splats:
        return Splats(self._project(gaussians, [view], sh_degree, antialiased)[0])

    def draw(
        self,
        gaussians: Gaussians,
        shots: Sequence[Shot],
        *,
        sh_degree: int,
        antialiased: bool = False,
        blend_weights: bool = False,
        residual_sums: bool = False,
        absgrad: bool = False,
    ) -> tuple[Raster, ...]:
        """See Rasterizer.draw. One pass for all shots: overheads are paid once.

        With `absgrad`, `info["means2d"].absgrad` [v, n, 2] is gsplat's after backward: sums of each pixel's
        absolute gradient. By the native kernel, of 3dgs.
        """
        planes = self._project(gaussians, [shot.view for shot in shots], sh_degree, antialiased)
        center = slice(self.primitive.center, self.primitive.center + 2)
        takes = planes.requires_grad
        means2d = planes.detach()[:, center].transpose(1, 2).contiguous().requires_grad_(takes)
        weights = torch.zeros_like(planes[:, DEPTH]).requires_grad_() if blend_weights else None
        frozen = [(k, shot.frozen.planes) for k, shot in enumerate(shots) if shot.frozen is not None]
        parts = [native.Part(own, k, shots[k].frozen is None) for k, own in enumerate(planes)]
        parts += [native.Part(others, k, True) for k, others in frozen]
        crops, windows = [shot.crop for shot in shots], [shot.z_window for shot in shots]
        lists = self._lists(gaussians, parts, crops, windows, blend_weights)
        if absgrad:
            if not isinstance(lists, native.Lists) or self.primitive.name != "3dgs":
                raise ValueError(NO_ABSGRAD)
            lists.absolute = means2d
        pictures, sums = lists.composite(planes, means2d, weights)
        info: dict[str, Any] = {"means2d": means2d, "radii": planes[:, -1].detach().int()}
        info |= {"weights": weights} if blend_weights else {}
        info |= {"sums": sums} if residual_sums else {}
        return tuple(Raster(*picture, info) for picture in pictures)

    @torch.no_grad()
    def cuts(
        self, gaussians: Gaussians, shots: Sequence[CutShot], *, sh_degree: int, antialiased: bool = False
    ) -> Iterator[Cut]:
        """See Rasterizer.cuts. Each view is projected and binned once, and a few are drawn in one pass."""
        for few in _a_few(shots, gaussians):
            planes = self._project(gaussians, [shot.view for shot in few], sh_degree, antialiased)
            lists = self._lists(gaussians, _each_a_picture(planes), [shot.crop for shot in few])
            kept = lists.kept_ids([shot.inside for shot in few]).view(len(few), len(gaussians))
            fronts, backs = ([s.front for s in few], [s.back for s in few])
            for own, held, *sides in zip(planes, kept, lists.draw(fronts), lists.draw(backs), strict=True):
                front, back = (Layer(color, left) for color, left, _ in sides)
                which = held.nonzero()[:, 0]
                yield Cut(front, back, Splats(own.index_select(1, which)), which)

    @torch.no_grad()
    def depth_windows(
        self, gaussians: Gaussians, shots: Sequence[Shot], *, visible: float, antialiased: bool = False
    ) -> Iterator[ZWindow]:
        """See Rasterizer.depth_windows. A few views are drawn in one pass."""
        for few in _a_few(shots, gaussians):
            crops = [shot.crop for shot in few]
            planes = self._project(gaussians, [shot.view for shot in few], 0, antialiased)
            shown = self._lists(gaussians, _each_a_picture(planes), crops).shown(visible)
            for crop, ends in zip(crops, shown, strict=True):
                yield ZWindow(self.window_grid(crop), *ends)

    @torch.no_grad()
    def deepened(
        self,
        gaussians: Gaussians,
        view: View,
        window: ZWindow | None,
        in_front: tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]],
        *,
        antialiased: bool = False,
    ) -> tuple[Float[Tensor, "h w"], Float[Tensor, "h w"]]:
        """Transmittance, right where above a half, and median depth with these Gaussians behind others.

        Of these `in_front` is the same: 1 and 0 for none. Without a `window` fragments count everywhere.
        """
        left, depth = in_front
        state = torch.stack((torch.where(left > 0.5, left, -left), depth))
        planes = self._project(gaussians, [view], 0, antialiased)
        self._lists(gaussians, _each_a_picture(planes), [view.full]).deepen([window], *state)
        return state[0].abs(), state[1]

    def _suits(self, gaussians: Gaussians, *planes: Tensor) -> bool:
        known = gaussians.features_rest.shape[1] in native.COEFFICIENTS
        return self._use_native and known and suits(gaussians.means, *planes)

    def _project(
        self, gaussians: Gaussians, views: Sequence[View], sh_degree: int, antialiased: bool
    ) -> Float[Tensor, "v r n"]:
        check_degree(gaussians, sh_degree)
        cameras = [camera_numbers(view, gaussians.means, sh_degree, antialiased) for view in views]
        learns_poses = torch.is_grad_enabled() and any(camera.requires_grad for camera in cameras)
        if learns_poses or not self._suits(gaussians):
            return project_in_torch(gaussians, cameras, self.primitive)
        return native.project(gaussians, torch.stack(cameras).detach(), self.primitive)

    def _lists(
        self,
        gaussians: Gaussians,
        parts: Sequence[native.Part],
        crops: Sequence[Crop],
        windows: native.Windows = (),
        wants_weights: bool = False,
    ) -> native.Lists | reference.Lists:
        if self._suits(gaussians, *(part.planes for part in parts)):
            return native.Lists(parts, crops, self.primitive, windows, wants_weights)
        return reference.find_lists(parts, crops, self.primitive, windows, self.tile_side)


def _a_few(shots: Sequence[AnyShot], gaussians: Gaussians) -> Iterator[list[AnyShot]]:
    return runs(shots, PIXELS_AT_ONCE, gaussians=len(gaussians), splats=SPLATS_AT_ONCE)


def _each_a_picture(planes: Float[Tensor, "v r n"]) -> list[native.Part]:
    return [native.Part(own, k) for k, own in enumerate(planes)]
