"""The torch rasterizer: gsplat's drawing in plain torch, for any device, with a z window per pixel."""

from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from abcd_ns.engine.rasterizer.base import Raster, ZWindow
from abcd_ns.engine.rasterizer.binning import TileLists, bin_splats
from abcd_ns.engine.rasterizer.chunk_kernels import ChunkKernels, CompilePolicy
from abcd_ns.engine.rasterizer.compositing_function import Composite, Job
from abcd_ns.engine.rasterizer.projection import Splats, project
from abcd_ns.engine.rasterizer.spherical_harmonics import sh_colors
from abcd_ns.engine.rasterizer.tile_grid import TileGrid
from abcd_ns.engine.types import Crop, Gaussians, View

TILE_SIDE = 4
"""Pixels along a tile's side; small, since Gaussians of low-resolution views are a few pixels wide."""
CHUNK = 16
"""Gaussians per kernel call and tile."""


class _TakeRows(torch.autograd.Function):
    """x[rows] for distinct rows. Autograd's own backward would accumulate, row by row."""

    @staticmethod
    def forward(ctx: Any, x: Float[Tensor, "n ..."], rows: Int[Tensor, "m"]) -> Float[Tensor, "m ..."]:
        ctx.save_for_backward(rows)
        ctx.n = x.shape[0]
        return x.index_select(0, rows)

    @staticmethod
    def backward(ctx: Any, grad: Float[Tensor, "m ..."]) -> tuple[Tensor, None]:
        (rows,) = ctx.saved_tensors
        return grad.new_zeros((ctx.n, *grad.shape[1:])).index_copy_(0, rows, grad), None


def _colors(gaussians: Gaussians, rows: Int[Tensor, "m"], view: View, sh_degree: int) -> Float[Tensor, "m 3"]:
    """Colours of the Gaussians at `rows`. Where these are few, only theirs are computed."""
    features = (gaussians.features_dc, gaussians.features_rest, gaussians.means)
    center = view.center.to(gaussians.means)
    if 2 * rows.numel() > len(gaussians):  # copying the coefficients out would cost more than it saves
        return _TakeRows.apply(sh_colors(*features, center, sh_degree), rows)
    return sh_colors(*(_TakeRows.apply(x, rows) for x in features), center, sh_degree)


def _ranked_colors(
    gaussians: Gaussians, frozen: Gaussians | None, rows: Int[Tensor, "m"], view: View, sh_degree: int
) -> Float[Tensor, "m 3"]:
    if frozen is None:
        return _colors(gaussians, rows, view, sh_degree)
    mine = rows < len(gaussians)
    own = _colors(gaussians, rows[mine], view, sh_degree)
    with torch.no_grad():
        others = _colors(frozen, rows[~mine] - len(gaussians), view, sh_degree)
    # Back into the order of `rows`, from the order (own, others).
    back = torch.cat((mine.nonzero()[:, 0], (~mine).nonzero()[:, 0])).argsort()
    return _TakeRows.apply(torch.cat((own, others)), back)


class TorchRasterizer:
    """gsplat 1.4.0's `rasterization(packed=False)` in plain torch: same picture, same gradient.

    Works in float32 and float64 and on any device; made to be fast on a CPU. Deterministic.

    Args:
        compile: whether float32 on the CPU runs on kernels built ahead of time (see built_kernels): "auto"
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
        splats = project(gaussians, view, antialiased=antialiased)
        info = _info(splats, view)
        splats = replace(splats, means2d=info["means2d"][0])  # so that info's tensor is in the graph
        if frozen is not None:
            with torch.no_grad():
                others = project(frozen, view, antialiased=antialiased)
            splats = Splats.cat(splats, others)
        windowed = None
        if z_window is not None:
            is_frozen = torch.arange(len(splats), device=gaussians.device) >= len(gaussians)
            windowed = is_frozen if frozen is not None else ~is_frozen
        lists = bin_splats(
            splats, TileGrid(crop, self.tile_side), self.chunk, windowed=windowed, window=z_window
        )
        colors = _ranked_colors(gaussians, frozen, lists.rows, view, sh_degree)
        job = self._job(lists, colors, windowed, z_window, info["means2d"] if absgrad else None)
        planes = Composite.apply(splats.means2d, splats.conics, colors, splats.opacities, splats.depths, job)
        return Raster(planes[1:4].permute(1, 2, 0), planes[0], planes[4], info)

    def _job(
        self,
        lists: TileLists,
        colors: Tensor,
        windowed: Tensor | None,
        window: ZWindow | None,
        target: Tensor | None,
    ) -> Job:
        if window is None:
            return Job(lists, self.kernels, None, torch.ones_like(colors[:, 0]), target)
        planes = lists.grid.to_tiles(torch.stack((window.near, window.far)).to(colors)).index_select(
            2, lists.tiles
        )
        return Job(lists, self.kernels, planes, (~windowed[lists.rows]).to(colors), target)


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
