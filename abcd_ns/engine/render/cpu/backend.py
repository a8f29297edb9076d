"""The torch rasterizer: gsplat's drawing in plain torch, for any device."""

import itertools
import weakref
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from abcd_ns.engine.render.base import Cut, CutShot, Raster, Rasterizer, Shot
from abcd_ns.engine.render.cpu.binning import Candidates, by_tile, find_candidates
from abcd_ns.engine.render.cpu.chunk_kernels import ChunkKernels, CompilePolicy
from abcd_ns.engine.render.cpu.compositing_function import Composite, Job, deepen, pair_weights
from abcd_ns.engine.render.image_size import image_size
from abcd_ns.engine.render.primitive import PRIMITIVES, Primitive, PrimitiveName
from abcd_ns.engine.render.projection import Splats, check_degree, pack, project_packed
from abcd_ns.engine.render.splat_kernels import DEPTH
from abcd_ns.engine.render.tile_grid import TileGrid, TileSheet
from abcd_ns.engine.render.together import runs
from abcd_ns.engine.render.z_window import ZWindow, showing
from abcd_ns.engine.types import Crop, Gaussians, Layer, View

TILE_SIDE = 4
"""Pixels along a tile's side; small, since Gaussians of low-resolution views are a few pixels wide."""
CHUNK = 8
"""Gaussians per kernel call and tile."""
PIXELS_AT_ONCE, SPLATS_AT_ONCE = 1 << 17, 200_000
"""Of the views that layers are drawn for in one pass, at most: for a few pixels or Gaussians calls cost more
than what they compute."""


class _TakeColumns(torch.autograd.Function):
    """x[:, columns] for distinct columns. Autograd's own backward would accumulate, one by one."""

    @staticmethod
    def forward(ctx: Any, x: Float[Tensor, "c n"], columns: Int[Tensor, "m"]) -> Float[Tensor, "c m"]:
        ctx.save_for_backward(columns)
        ctx.width = x.shape[1]
        return x.index_select(1, columns)

    @staticmethod
    def backward(ctx: Any, grad: Float[Tensor, "c m"]) -> tuple[Float[Tensor, "c n"], None]:
        (columns,) = ctx.saved_tensors
        return grad.new_zeros((grad.shape[0], ctx.width)).index_copy_(1, columns, grad), None


class TorchRasterizer(Rasterizer):
    """gsplat 1.4.0's `rasterization(packed=False)` or `rasterization_2dgs` in plain torch: same picture, same
    gradient.

    Works in float32 and float64 and on any device; made to be fast on a CPU. Deterministic.

    Args:
        compile: whether float32 on the CPU runs on kernels built ahead of time (see kernels): "auto" if they
            are found, "never" not at all. Built and eager kernels agree to rounding only.
        tile_side: pixels along a tile's side; a divisor of 16. Speed only.
        chunk: Gaussians per kernel call and tile. Speed and memory only.
        window_side: pixels along the sides of the tiles of its z windows; 0 takes `tile_side`.
        primitive: what a Gaussian is.

    Raises:
        ValueError: `tile_side` does not divide 16, or `window_side` is no multiple of it.
    """

    def __init__(
        self,
        compile: CompilePolicy = "auto",
        *,
        tile_side: int = TILE_SIDE,
        chunk: int = CHUNK,
        window_side: int = 0,
        primitive: PrimitiveName = "3dgs",
    ) -> None:
        if tile_side < 1 or 16 % tile_side:
            raise ValueError(f"tile_side is {tile_side}; choose one of 1, 2, 4, 8, 16.")
        if window_side % tile_side:
            raise ValueError(f"window_side is {window_side}; choose a multiple of tile_side, {tile_side}.")
        self.primitive = PRIMITIVES[primitive]
        self.name = f"{self.primitive.prefix}torch-3"
        self.kernels = ChunkKernels(compile, tile_side, chunk, self.primitive)
        self.tile_side = tile_side
        self.chunk = chunk
        self.window_side = window_side or tile_side
        self._packed: tuple[weakref.ref[Gaussians], Tensor] | None = None

    def warm_up(self) -> None:
        """See Rasterizer.warm_up."""
        self.kernels.warm_up()

    @torch.no_grad()
    def project(
        self, gaussians: Gaussians, view: View, *, sh_degree: int = 0, antialiased: bool = False
    ) -> Splats:
        """See Rasterizer.project."""
        check_degree(gaussians, sh_degree)
        return self._project(self._pack(gaussians), view, sh_degree, antialiased)

    def _project(self, packed: Float[Tensor, "p n"], view: View, sh_degree: int, antialiased: bool) -> Splats:
        options = {"built": self.kernels.built, "primitive": self.primitive}
        return project_packed(packed, view, sh_degree=sh_degree, antialiased=antialiased, **options)

    def draw(
        self,
        gaussians: Gaussians,
        shots: Sequence[Shot],
        *,
        sh_degree: int,
        antialiased: bool = False,
        absgrad: bool = False,
        weigh: bool = False,
    ) -> tuple[Raster, ...]:
        """See Rasterizer.draw. One pass for all shots: overheads are paid once."""
        check_degree(gaussians, sh_degree)
        packed = pack(gaussians)
        seen = [self._project(packed, shot.view, sh_degree, antialiased) for shot in shots]
        own = torch.stack([splats.planes for splats in seen])
        rows, center, depth = _graded(own, self.primitive)
        info = _info(rows[center].transpose(1, 2), own, shots)
        rows[center] = info["means2d"].transpose(1, 2)  # through info's tensor, so that it is in the graph
        if weigh:
            info["weights"] = torch.zeros_like(own[:, DEPTH], requires_grad=True)
            rows[depth] = info["weights"][:, None]
        graded, bounds = _side_by_side(torch.cat(rows, dim=1)), _side_by_side(own.detach())
        grid_of = torch.arange(len(shots), device=own.device).repeat_interleave(own.shape[2])
        frozen = [(k, shot.frozen.planes) for k, shot in enumerate(shots) if shot.frozen is not None]
        if frozen:
            others = [_without_depths(planes) if weigh else planes for _, planes in frozen]
            graded = torch.cat((graded, *(planes[: self.primitive.graded] for planes in others)), dim=1)
            bounds = torch.cat((bounds, *(planes for _, planes in frozen)), dim=1)
            grid_of = torch.cat((grid_of, *(grid_of.new_full((p.shape[1],), k) for k, p in frozen)))
        sheet = TileSheet(tuple(TileGrid(shot.crop, self.tile_side) for shot in shots))
        candidates = self._find(Splats(bounds), grid_of, sheet)
        if any(shot.z_window is not None for shot in shots):
            masked = _masked(shots, grid_of, own.shape[0] * own.shape[2])
            candidates = candidates.within([shot.z_window for shot in shots], masked)
        sums_absolute = absgrad and self.primitive.has_absgrad
        job = self._job(candidates, bounds, info["means2d"] if sums_absolute else None)
        images = sheet.to_images(Composite.apply(_TakeColumns.apply(graded, candidates.rows), job))
        # See _graded.
        parts = [image.split((1, 3, 1)) for image in images]
        return tuple(Raster(color.permute(1, 2, 0), left[0], depth[0], info) for left, color, depth in parts)

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
        options = {"sh_degree": sh_degree, "antialiased": antialiased}
        seen = [self.project(gaussians, shot.view, **options) for shot in shots]
        splats, candidates = self._candidates(seen, [shot.crop for shot in shots])
        members = candidates.within([shot.inside for shot in shots]).members
        firsts = torch.arange(len(shots) + 1, device=members.device) * len(gaussians)
        ends = torch.searchsorted(members, firsts).tolist()
        members = [members[a:b] - k * len(gaussians) for k, (a, b) in enumerate(itertools.pairwise(ends))]
        front = self._layers(splats, candidates.within([shot.front for shot in shots]))
        back = self._layers(splats, candidates.within([shot.back for shot in shots]))
        inside = [own[which] for own, which in zip(seen, members, strict=True)]
        return [Cut(*parts) for parts in zip(front, back, inside, members, strict=True)]

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
        projected = [self.project(gaussians, view, antialiased=antialiased) for view, _ in seen]
        splats, candidates = self._candidates(projected, [crop for _, crop in seen])
        drawn = splats.planes[: self.primitive.graded].index_select(1, candidates.rows)
        weight = pair_weights(drawn, self._job(candidates, splats.planes))
        # Pairs come by depth, so that sorting by tile alone keeps them in order.
        tile, order = by_tile(candidates.pairs.tile, candidates.sheet.tiles)
        z, weight = candidates.z.index_select(0, order), weight.index_select(0, order)
        firsts = candidates.sheet.starts
        ends = torch.searchsorted(tile, tile.new_tensor(firsts)).tolist()
        found = []
        for k, drawn_in in enumerate(candidates.sheet.grids):
            grid, own = self.window_grid(drawn_in.crop), slice(ends[k], ends[k + 1])
            held, of_pairs = tile[own].long() - firsts[k], (z[own], weight[own])
            if grid != drawn_in:
                held, again = grid.holding(drawn_in, held).sort(stable=True)
                of_pairs = tuple(values[again] for values in of_pairs)
            near, far = showing(grid.pixels(held.device)[None], held, *of_pairs, visible).flatten(1)
            found.append(ZWindow(grid, near, far))
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
        seen = [self.project(gaussians, view, antialiased=antialiased)]
        splats, candidates = self._candidates(seen, [view.full])
        candidates = candidates if window is None else candidates.within([window])
        drawn = splats.planes[: self.primitive.graded].index_select(1, candidates.rows)
        left, depth = in_front
        state = torch.stack((torch.where(left > 0.5, left, -left), depth))
        tiled = candidates.sheet.to_tiles([state], fill=-1.0)
        (found,) = candidates.sheet.to_images(deepen(drawn, self._job(candidates, splats.planes), tiled))
        return found[0].abs(), found[1]

    def _candidates(self, seen: Sequence[Splats], crops: Sequence[Crop]) -> tuple[Splats, Candidates]:
        """What several views see, as one drawing; splats are numbered through, view by view."""
        sheet = TileSheet(tuple(TileGrid(crop, self.tile_side) for crop in crops))
        splats = Splats(torch.cat([splats.planes for splats in seen], dim=1)) if len(seen) > 1 else seen[0]
        grid_of = torch.arange(len(seen), device=splats.planes.device).repeat_interleave(len(seen[0]))
        return splats, self._find(splats, grid_of, sheet)

    def _find(self, splats: Splats, grid_of: Int[Tensor, "n"], sheet: TileSheet) -> Candidates:
        options = {"built": self.kernels.built, "primitive": self.primitive}
        return find_candidates(splats, grid_of, sheet, **options)

    def _layers(self, splats: Splats, candidates: Candidates) -> list[Layer]:
        drawn = splats.planes[: self.primitive.graded].index_select(1, candidates.rows)
        images = candidates.sheet.to_images(Composite.apply(drawn, self._job(candidates, splats.planes)))
        return [Layer(image[1:4].permute(1, 2, 0), image[0]) for image in images]

    def _pack(self, gaussians: Gaussians) -> Float[Tensor, "p n"]:
        """`pack`, kept for the next view of the same Gaussians."""
        if self._packed is None or self._packed[0]() is not gaussians:
            self._packed = (weakref.ref(gaussians, self._forget_packed), pack(gaussians))
        return self._packed[1]

    def _forget_packed(self, of: weakref.ref[Gaussians]) -> None:
        if self._packed is not None and self._packed[0] is of:
            self._packed = None

    def _job(
        self, candidates: Candidates, planes: Float[Tensor, "r n"], absgrad_target: Tensor | None = None
    ) -> Job:
        return Job(candidates.lists(self.chunk), planes.shape[1], self.kernels, absgrad_target)


def _without_depths(planes: Float[Tensor, "r n"]) -> Float[Tensor, "r n"]:
    rest = planes[DEPTH + 1 :]
    return torch.cat((planes[:DEPTH], torch.zeros_like(planes[DEPTH : DEPTH + 1]), rest))


def _side_by_side(planes: Float[Tensor, "v r n"]) -> Float[Tensor, "r vn"]:
    """The columns of all views in one row after the other."""
    return planes.transpose(0, 1).reshape(planes.shape[1], -1)


def _masked(shots: Sequence[Shot], grid_of: Int[Tensor, "n"], own: int) -> Bool[Tensor, "n"]:
    """Which splats the shots' windows apply to; the first `own` splats are not frozen."""
    is_frozen = torch.arange(grid_of.numel(), device=grid_of.device) >= own
    masks_frozen = torch.tensor([shot.frozen is not None for shot in shots], device=grid_of.device)
    return is_frozen == masks_frozen[grid_of]


def _graded(own: Float[Tensor, "v r n"], primitive: Primitive) -> tuple[list[Tensor], int, int]:
    """The rows of planes that take gradients, in five parts, and which of these are centers and depths. It is
    one split, whose gradients are put together once; those of slices are added up, each as large as all."""
    (first, wide), (second, narrow) = sorted({primitive.center: 2, DEPTH: 1}.items())
    sizes = (first, wide, second - first - wide, narrow, primitive.graded - second - narrow)
    rows = list(own.split((*sizes, own.shape[1] - primitive.graded), dim=1))[:-1]
    return rows, *((1, 3) if primitive.center < DEPTH else (3, 1))


def _info(
    means2d: Float[Tensor, "v n 2"], own: Float[Tensor, "v r n"], shots: Sequence[Shot]
) -> dict[str, Any]:
    """What gsplat's densification strategies read."""
    return {
        "means2d": means2d,
        "radii": own[:, -1].detach().int(),
        **image_size([shot.view for shot in shots], own.device),
        "n_cameras": len(shots),
        "gaussian_ids": None,
    }
