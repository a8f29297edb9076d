"""The torch rasterizer: gsplat's drawing in plain torch, for any device, with a z window per pixel."""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from abcd_ns.engine.rasterizer.base import Raster, ZWindow
from abcd_ns.engine.rasterizer.binning import TileLists, bin_splats, find_candidates
from abcd_ns.engine.rasterizer.chunk_kernels import ChunkKernels, CompilePolicy
from abcd_ns.engine.rasterizer.compositing_function import Composite, Job
from abcd_ns.engine.rasterizer.projection import Splats, project
from abcd_ns.engine.rasterizer.spherical_harmonics import sh_colors
from abcd_ns.engine.rasterizer.splat_kernels import DEPTH, OPACITY
from abcd_ns.engine.rasterizer.tile_grid import TileGrid
from abcd_ns.engine.types import Crop, Gaussians, Layer, View

TILE_SIDE = 4
"""Pixels along a tile's side; small, since Gaussians of low-resolution views are a few pixels wide."""
CHUNK = 16
"""Gaussians per kernel call and tile."""


class _TakeRows(torch.autograd.Function):
    """x[rows] along a dimension, for distinct rows. Autograd's own backward would accumulate, row by row."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, rows: Int[Tensor, "m"], dim: int) -> Tensor:
        ctx.save_for_backward(rows)
        ctx.shape, ctx.dim = x.shape, dim
        return x.index_select(dim, rows)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:
        (rows,) = ctx.saved_tensors
        return grad.new_zeros(ctx.shape).index_copy_(ctx.dim, rows, grad), None, None


def _colors(
    gaussians: Gaussians, splats: Splats, rows: Int[Tensor, "m"], sh_degree: int
) -> Float[Tensor, "m 3"]:
    """Colours of the Gaussians at `rows`. Where these are few, only theirs are computed."""
    features = (gaussians.features_dc, gaussians.features_rest)
    if 2 * rows.numel() > len(gaussians):  # copying the coefficients out would cost more than it saves
        return _TakeRows.apply(sh_colors(*features, splats.bases, sh_degree), rows, 0)
    dc, rest = (_TakeRows.apply(x, rows, 0) for x in features)
    return sh_colors(dc, rest, _TakeRows.apply(splats.bases, rows, 1), sh_degree)


def _colors_by_rank(
    gaussians: Gaussians,
    own: Splats,
    frozen: Gaussians | None,
    others: Splats | None,
    rows: Int[Tensor, "m"],
    sh_degree: int,
) -> Float[Tensor, "m 3"]:
    """Colours of the drawn ones among the active Gaussians followed by the frozen ones."""
    if frozen is None or others is None:
        return _colors(gaussians, own, rows, sh_degree)
    mine, theirs = (rows < len(gaussians)).nonzero()[:, 0], (rows >= len(gaussians)).nonzero()[:, 0]
    own_colors = _colors(gaussians, own, rows.index_select(0, mine), sh_degree)
    with torch.no_grad():
        their_colors = _colors(frozen, others, rows.index_select(0, theirs) - len(gaussians), sh_degree)
    # Back into the order of `rows`, from the order (mine, theirs).
    back = torch.empty_like(rows).index_copy_(
        0, torch.cat((mine, theirs)), torch.arange(len(rows), device=rows.device)
    )
    return _TakeRows.apply(torch.cat((own_colors, their_colors)), back, 0)


class TorchRasterizer:
    """gsplat 1.4.0's `rasterization(packed=False)` in plain torch: same picture, same gradient.

    Works in float32 and float64 and on any device; made to be fast on a CPU. Deterministic.

    Args:
        compile: whether float32 on the CPU runs on kernels built ahead of time (see kernels): "auto"
            if they are found, "always" building them now if need be, "never" not at all. Built and eager
            kernels agree to rounding only: use "never" where last bits must not depend on the machine.
        tile_side: pixels along a tile's side; a divisor of 16. Speed only.
        chunk: Gaussians per kernel call and tile. Speed and memory only.

    Raises:
        ValueError: `tile_side` does not divide 16.
    """

    name = "torch-1"
    supports_z_window = True

    def __init__(
        self, compile: CompilePolicy = "auto", *, tile_side: int = TILE_SIDE, chunk: int = CHUNK
    ) -> None:
        if tile_side < 1 or 16 % tile_side:
            raise ValueError(f"tile_side is {tile_side}; choose one of 1, 2, 4, 8, 16.")
        self.kernels = ChunkKernels(compile, tile_side, chunk)
        self.tile_side = tile_side
        self.chunk = chunk

    def warm_up(self) -> None:
        """See Rasterizer.warm_up."""
        self.kernels.warm_up()

    def __call__(
        self,
        gaussians: Gaussians,
        view: View,
        *,
        sh_degree: int,
        crop: Crop | None = None,
        frozen: Gaussians | None = None,
        z_window: ZWindow | None = None,
        antialiased: bool = False,
        absgrad: bool = False,
    ) -> Raster:
        """See Rasterizer.__call__."""
        crop = crop or view.full
        _check_window(z_window, crop)
        built = self.kernels.built
        own = project(gaussians, view, antialiased=antialiased, built=built)
        info = _info(own, view)
        # Through info's tensor, so that it is in the graph.
        graded = torch.cat((info["means2d"][0].T, own.planes[DEPTH : OPACITY + 1]))
        splats, others = own, None
        if frozen is not None:
            with torch.no_grad():
                others = project(frozen, view, antialiased=antialiased, built=built)
            splats = Splats(torch.cat((own.planes.detach(), others.planes), dim=1))
            graded = torch.cat((graded, others.planes[: OPACITY + 1]), dim=1)
        windowed = None
        if z_window is not None:
            is_frozen = torch.arange(len(splats), device=gaussians.device) >= len(gaussians)
            windowed = is_frozen if frozen is not None else ~is_frozen
        grid = TileGrid(crop, self.tile_side)
        lists = bin_splats(splats, grid, self.chunk, windowed=windowed, window=z_window, built=built)
        colors = _colors_by_rank(gaussians, own, frozen, others, lists.rows, sh_degree)
        drawn = torch.cat((_TakeRows.apply(graded, lists.rows, 1), colors.T))
        job = self._job(lists, len(splats), colors, windowed, z_window, info["means2d"] if absgrad else None)
        planes = Composite.apply(drawn, job)
        return Raster(planes[1:4].permute(1, 2, 0), planes[0], planes[4], info)

    @torch.no_grad()
    def layers(
        self,
        gaussians: Gaussians,
        view: View,
        windows: Sequence[ZWindow],
        *,
        sh_degree: int,
        crop: Crop,
        antialiased: bool = False,
    ) -> list[Layer]:
        """See Rasterizer.layers."""
        built = self.kernels.built
        splats = project(gaussians, view, antialiased=antialiased, built=built)
        candidates = find_candidates(splats, TileGrid(crop, self.tile_side), built=built)
        colors = _colors(gaussians, splats, candidates.rows, sh_degree)
        drawn = torch.cat((candidates.ranked.planes[: OPACITY + 1], colors.T))
        all_windowed = torch.ones(len(splats), dtype=torch.bool, device=gaussians.device)
        drawings = []
        for window in windows:
            _check_window(window, crop)
            lists = candidates.lists(self.chunk, all_windowed, window)
            planes = Composite.apply(drawn, self._job(lists, len(splats), colors, all_windowed, window, None))
            drawings.append(Layer(planes[1:4].permute(1, 2, 0), planes[0]))
        return drawings

    def _job(
        self,
        lists: TileLists,
        splats: int,
        colors: Tensor,
        windowed: Tensor | None,
        window: ZWindow | None,
        target: Tensor | None,
    ) -> Job:
        if window is None:
            return Job(lists, splats, self.kernels, None, torch.ones_like(colors[:, 0]), target)
        planes = lists.grid.to_tiles(torch.stack((window.near, window.far)).to(colors)).index_select(
            2, lists.tiles
        )
        return Job(lists, splats, self.kernels, planes, (~windowed[lists.rows]).to(colors), target)


def _check_window(window: ZWindow | None, crop: Crop) -> None:
    if window is not None and window.near.shape != (crop.height, crop.width):
        shape = tuple(window.near.shape)
        raise ValueError(
            f"The z window is {shape}, but the crop is {(crop.height, crop.width)}; give it the crop's size."
        )


def _info(splats: Splats, view: View) -> dict[str, Any]:
    """What gsplat's densification strategies read."""
    return {
        "means2d": splats.means2d[None],
        "radii": splats.radii[None],
        "depths": splats.depths[None],
        "conics": splats.conics[None],
        "opacities": splats.opacities[None],
        "width": view.width,
        "height": view.height,
        "n_cameras": 1,
        "camera_ids": None,
        "gaussian_ids": None,
    }
