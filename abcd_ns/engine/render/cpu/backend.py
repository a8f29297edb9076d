"""The torch rasterizer: gsplat's drawing for any device, by the native library on a CPU."""

import itertools
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from abcd_ns.engine.kernels import library
from abcd_ns.engine.kernels.native import suits
from abcd_ns.engine.render.base import Cut, CutShot, Raster, Rasterizer, Shot
from abcd_ns.engine.render.cpu import native, reference
from abcd_ns.engine.render.primitive import PRIMITIVES, PrimitiveName
from abcd_ns.engine.render.projection import Splats, camera_numbers, check_degree, project_in_torch
from abcd_ns.engine.render.residual_sums import ResidualSums, SumsApart
from abcd_ns.engine.render.splat_kernels import DEPTH
from abcd_ns.engine.render.together import runs
from abcd_ns.engine.render.z_window import ZWindow, showing, window_between
from abcd_ns.engine.types import Crop, Gaussians, Layer, View

PIXELS_AT_ONCE, SPLATS_AT_ONCE = 1 << 17, 200_000
"""Of the views that layers are drawn for in one pass, at most: for a few pixels or Gaussians calls cost more
than what they compute."""


class TorchRasterizer(Rasterizer):
    """gsplat 1.4.0's `rasterization(packed=False)` or `rasterization_2dgs`: same picture, same gradient.

    Float32 on a CPU is drawn by the native library (see kernels), all else in plain torch: 20 times slower,
    the reference. Both are deterministic, whatever the number of threads, and agree to rounding.

    Args:
        use_native: False draws everything in torch.
        tile_side: pixels along a tile's side; a divisor of 16. The native library has 4.
        window_side: pixels along the sides of the tiles of its z windows; 0 takes `tile_side`.
        primitive: what a Gaussian is.

    Raises:
        ValueError: `tile_side` does not divide 16, or `window_side` is no multiple of it.
    """

    def __init__(
        self,
        *,
        use_native: bool = True,
        tile_side: int = native.SIDE,
        window_side: int = 0,
        primitive: PrimitiveName = "3dgs",
    ) -> None:
        if tile_side < 1 or 16 % tile_side:
            raise ValueError(f"tile_side is {tile_side}; choose one of 1, 2, 4, 8, 16.")
        if window_side % tile_side:
            raise ValueError(f"window_side is {window_side}; choose a multiple of tile_side, {tile_side}.")
        self.primitive = PRIMITIVES[primitive]
        self.name = f"{self.primitive.prefix}torch-4"
        self.tile_side = tile_side
        self.window_side = window_side or tile_side
        self._use_native = use_native and tile_side == native.SIDE

    def warm_up(self) -> None:
        """See Rasterizer.warm_up. The library's threads take the place of torch's, see share_cores."""
        if self._use_native and library() is not None:
            torch.set_num_threads(1)

    def _suits(self, gaussians: Gaussians, *others: Tensor) -> bool:
        known = gaussians.features_rest.shape[1] in native.COEFFICIENTS
        return self._use_native and known and suits(gaussians.means, *others)

    @torch.no_grad()
    def project(
        self, gaussians: Gaussians, view: View, *, sh_degree: int = 0, antialiased: bool = False
    ) -> Splats:
        """See Rasterizer.project."""
        return Splats(self._project(gaussians, [view], sh_degree, antialiased)[0])

    def _project(
        self, gaussians: Gaussians, views: Sequence[View], sh_degree: int, antialiased: bool
    ) -> Float[Tensor, "v r n"]:
        check_degree(gaussians, sh_degree)
        cameras = [camera_numbers(view, gaussians.means, sh_degree, antialiased) for view in views]
        learns_poses = torch.is_grad_enabled() and any(camera.requires_grad for camera in cameras)
        if learns_poses or not self._suits(gaussians):
            return project_in_torch(gaussians, cameras, self.primitive)
        return native.project(gaussians, torch.stack(cameras).detach(), self.primitive)

    def draw(
        self,
        gaussians: Gaussians,
        shots: Sequence[Shot],
        *,
        sh_degree: int,
        antialiased: bool = False,
        blend_weights: bool = False,
        judge: bool = False,
        absgrad: bool = False,
    ) -> tuple[Raster, ...]:
        """See Rasterizer.draw. One pass for all shots: overheads are paid once.

        Args:
            absgrad: after backward `info["means2d"].absgrad` [v, n, 2] is gsplat's: sums of each pixel's
                absolute gradient. By the native kernel, of 3dgs.
        """
        planes = self._project(gaussians, [shot.view for shot in shots], sh_degree, antialiased)
        center = slice(self.primitive.center, self.primitive.center + 2)
        takes = planes.requires_grad
        means2d = planes.detach()[:, center].transpose(1, 2).contiguous().requires_grad_(takes)
        weights = torch.zeros_like(planes[:, DEPTH]).requires_grad_() if blend_weights else None
        info = _info(means2d, planes, shots) | ({"weights": weights} if blend_weights else {})
        frozen = [(k, shot.frozen.planes) for k, shot in enumerate(shots) if shot.frozen is not None]
        crops, windows = [shot.crop for shot in shots], [shot.z_window for shot in shots]
        if self._suits(gaussians, planes, *(others for _, others in frozen)):
            parts = [native.Part(own, k, shots[k].frozen is None) for k, own in enumerate(planes)]
            parts += [native.Part(others, k, True) for k, others in frozen]
            lists = native.Lists(parts, crops, self.primitive, windows, wants_weights=blend_weights)
            drawing = native.Drawing(lists, means2d=means2d if absgrad else None)
            info |= {"sums": drawing} if judge else {}
            drawn = iter(native.Composite.apply(planes, means2d, weights, drawing))
            return tuple(
                Raster(color, left, depth, info) for color, left, depth in zip(*[drawn] * 3, strict=True)
            )
        if absgrad:
            raise ValueError("absgrad takes the native kernel: float32 on a CPU, and a compiler")
        images, sums = self._composited_in_torch(planes, shots, means2d, weights)
        info |= {"sums": sums} if judge else {}
        return tuple(Raster(image[1:4].permute(1, 2, 0), image[0], image[4], info) for image in images)

    def _composited_in_torch(
        self,
        planes: Float[Tensor, "v r n"],
        shots: Sequence[Shot],
        means2d: Float[Tensor, "v n 2"],
        weights: Float[Tensor, "v n"] | None,
    ) -> tuple[list[Float[Tensor, "5 h w"]], ResidualSums]:
        """By reference.composite; see native.Composite for `means2d` and `weights`."""
        center = self.primitive.center
        frozen = [(k, shot.frozen.planes) for k, shot in enumerate(shots) if shot.frozen is not None]
        windows = [shot.z_window for shot in shots]
        # The leaves add nothing, and get the gradients.
        own = list(planes[:, : self.primitive.graded].unbind(1))
        for axis in range(2):
            own[center + axis] = own[center + axis] + (means2d - means2d.detach())[..., axis]
        own[DEPTH] = own[DEPTH] if weights is None else weights
        others = [part[: self.primitive.graded].clone() for _, part in frozen]
        for part in others if weights is not None else ():
            part[DEPTH] = 0.0
        rows = torch.cat((torch.stack(own).flatten(1), *others), dim=1)
        bounds = torch.cat((*planes.detach(), *(part for _, part in frozen)), dim=1)
        counts = [planes.shape[2]] * len(shots) + [part.shape[1] for _, part in frozen]
        places = [*range(len(shots)), *(k for k, _ in frozen)]
        picture = _repeated(places, counts, planes)
        lists = reference.find_lists(bounds, picture, [s.crop for s in shots], self.tile_side, self.primitive)
        if any(window is not None for window in windows):
            applies = [shot.frozen is None for shot in shots] + [True] * len(frozen)
            lists = lists.within(windows, _repeated(applies, counts, planes))
        images, drawn = reference.composite(rows, lists, self.primitive), rows.detach()

        def find(residuals: Sequence[Tensor]) -> Float[Tensor, "v n 10"]:
            sums = reference.residual_sums(drawn, lists, self.primitive, residuals)
            return sums[: means2d[..., 0].numel()].view(*means2d.shape[:2], -1)

        return images, SumsApart(find)

    @torch.no_grad()
    def cuts(
        self, gaussians: Gaussians, shots: Sequence[CutShot], *, sh_degree: int, antialiased: bool = False
    ) -> Iterator[Cut]:
        """See Rasterizer.cuts. Each view is projected and binned once, and a few are drawn in one pass."""
        crops = [shot.crop for shot in shots]
        for few in runs(shots, crops, PIXELS_AT_ONCE, gaussians=len(gaussians), splats=SPLATS_AT_ONCE):
            yield from self._cut_together(gaussians, few, sh_degree, antialiased)

    def _cut_together(
        self, gaussians: Gaussians, shots: Sequence[CutShot], sh_degree: int, antialiased: bool
    ) -> list[Cut]:
        planes = self._project(gaussians, [shot.view for shot in shots], sh_degree, antialiased)
        front, inside, back = ([getattr(shot, n) for shot in shots] for n in ("front", "inside", "back"))
        lists = self._lists(gaussians, planes, [shot.crop for shot in shots])
        kept_ids = self._kept_ids(lists, inside, len(gaussians), len(shots))
        layers = zip(*(self._layers(lists, planes, each) for each in (front, back)), strict=True)
        return [
            Cut(*both, Splats(own.index_select(1, which)), which)
            for both, own, which in zip(layers, planes, kept_ids, strict=True)
        ]

    @torch.no_grad()
    def depth_windows(
        self,
        gaussians: Gaussians,
        seen: Sequence[tuple[View, Crop]],
        *,
        visible: float,
        antialiased: bool = False,
    ) -> Iterator[ZWindow]:
        """See Rasterizer.depth_windows. A few views are drawn in one pass."""
        crops = [crop for _, crop in seen]
        for few in runs(seen, crops, PIXELS_AT_ONCE, gaussians=len(gaussians), splats=SPLATS_AT_ONCE):
            yield from self._windows_together(gaussians, few, visible, antialiased)

    def _windows_together(
        self, gaussians: Gaussians, seen: Sequence[tuple[View, Crop]], visible: float, antialiased: bool
    ) -> list[ZWindow]:
        planes = self._project(gaussians, [view for view, _ in seen], 0, antialiased)
        crops = [crop for _, crop in seen]
        grids = [self.window_grid(crop) for crop in crops]
        native_too = self.window_side == self.tile_side
        lists = self._lists(gaussians, planes, crops, native_too)
        if isinstance(lists, native.Lists):
            ends = [window_between(*each).flatten(1) for each in lists.shown(visible)]
            return [ZWindow(grid, *both) for grid, both in zip(grids, ends, strict=True)]
        weight = reference.pair_weights(self._drawn(planes), lists, self.primitive)
        found, ends = [], torch.searchsorted(lists.tile, lists.tile.new_tensor(lists.starts)).tolist()
        for k, (grid, drawn_in) in enumerate(zip(grids, lists.grids, strict=True)):
            own = slice(ends[k], ends[k + 1])
            held = grid.holding(drawn_in, lists.tile[own] - lists.starts[k])
            # By tile, then by depth, where tiles of windows hold several.
            order = lists.z[own].sort(stable=True).indices
            order = order[held[order].sort(stable=True).indices]
            of_pairs = (values[own][order] for values in (lists.z, weight))
            both = showing(grid.pixels(held.device)[None], held[order], *of_pairs, visible).flatten(1)
            found.append(ZWindow(grid, *both))
        return found

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

        Args:
            window: where in each tile fragments count; None for everywhere.
            in_front: the same of the others; for none 1 and 0.
        """
        planes = self._project(gaussians, [view], 0, antialiased)
        lists, (left, depth) = self._lists(gaussians, planes, [view.full]), in_front
        state = torch.stack((torch.where(left > 0.5, left, -left), depth))
        if isinstance(lists, native.Lists):
            lists.deepen([window], *state)
        else:
            lists = lists if window is None else lists.within([window])
            state = reference.deepen(self._drawn(planes), lists, self.primitive, state)
        return state[0].abs(), state[1]

    def _lists(
        self,
        gaussians: Gaussians,
        planes: Float[Tensor, "v r n"],
        crops: Sequence[Crop],
        native_too: bool = True,
    ) -> native.Lists | reference.Lists:
        """What several views see, as one drawing; columns are numbered through, view by view."""
        if native_too and self._suits(gaussians):
            return native.Lists([native.Part(own, k) for k, own in enumerate(planes)], crops, self.primitive)
        picture = _repeated(range(len(planes)), [planes.shape[2]] * len(planes), planes)
        return reference.find_lists(_side_by_side(planes), picture, crops, self.tile_side, self.primitive)

    def _drawn(self, planes: Float[Tensor, "v r n"]) -> Float[Tensor, "d vn"]:
        """What compositing reads of several views."""
        return _side_by_side(planes[:, : self.primitive.graded])

    def _kept_ids(
        self, lists: native.Lists | reference.Lists, windows: Sequence[ZWindow], count: int, views: int
    ) -> list[Int[Tensor, "m"]]:
        """By view the Gaussians with a pair in the window, ascending."""
        if isinstance(lists, native.Lists):
            return [own.nonzero()[:, 0] for own in lists.kept_ids(windows).view(views, count)]
        found = lists.within(windows).column.unique()
        firsts = torch.arange(views + 1, device=found.device) * count
        ends = torch.searchsorted(found, firsts).tolist()
        return [found[a:b] - k * count for k, (a, b) in enumerate(itertools.pairwise(ends))]

    def _layers(
        self, lists: native.Lists | reference.Lists, planes: Tensor, windows: Sequence[ZWindow]
    ) -> list[Layer]:
        if isinstance(lists, native.Lists):
            return [Layer(color, left) for color, left, _ in lists.draw(windows)]
        images = reference.composite(self._drawn(planes), lists.within(windows), self.primitive)
        return [Layer(image[1:4].permute(1, 2, 0), image[0]) for image in images]


def _side_by_side(planes: Float[Tensor, "v r n"]) -> Float[Tensor, "r vn"]:
    """The columns of all views, one view after the other."""
    return planes.transpose(0, 1).flatten(1)


def _repeated(values: Sequence[int | bool], counts: Sequence[int], like: Tensor) -> Tensor:
    """Each value as often as its count, on the device of `like`."""
    values, counts = (torch.tensor(list(each), device=like.device) for each in (values, counts))
    return torch.repeat_interleave(values, counts)


def _info(
    means2d: Float[Tensor, "v n 2"], planes: Float[Tensor, "v r n"], shots: Sequence[Shot]
) -> dict[str, Any]:
    """What gsplat's densification strategies read."""
    return {
        "means2d": means2d,
        "radii": planes[:, -1].detach().int(),
        **_image_size([shot.view for shot in shots], planes.device),
        "n_cameras": len(shots),
        "gaussian_ids": None,
    }


def _image_size(views: Sequence[View], device: torch.device | str) -> dict[str, int | Tensor]:
    """`width` and `height` of an `info`: of all views, or, where they differ, of each, [v, 1].

    gsplat's strategies multiply gradients [v, n] by them, to bring these to one scale.
    """
    sizes = [(view.width, view.height) for view in views]
    if len(set(sizes)) == 1:
        return dict(zip(("width", "height"), sizes[0], strict=True))
    width, height = torch.tensor(sizes, device=device).T[..., None]
    return {"width": width, "height": height}
