"""Which Gaussians each small tile has to draw, in what order: the lists that the compositing kernels walk.

gsplat draws a Gaussian on every pixel of every 16 px tile that the square of its radius touches, where its
alpha reaches 1/255. Here tiles are smaller and lists tighter: a (Gaussian, tile) pair is kept only if the
alpha >= 1/255 ellipse reaches the tile's rows of pixel centres, and gsplat's rectangle holds the tile. No
fragment is lost by that, and none is added.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from abcd_ns.engine.rasterizer.base import ZWindow
from abcd_ns.engine.rasterizer.projection import Splats
from abcd_ns.engine.rasterizer.tile_grid import TileGrid

GSPLAT_TILE = 16
"""gsplat's tile size in pixels; decides which pixels a Gaussian may touch."""
MIN_ALPHA = 1.0 / 255.0
"""Fragments with less alpha are not drawn."""
REACH_MARGIN = 0.01
"""Added to the squared Mahalanobis radius of the bounds, so that rounding never loses a fragment."""
SHRINK = 0.875
"""A level is narrowed once fewer than this share of its tiles still have Gaussians to draw."""


@dataclass(frozen=True)
class Level:
    """The n-th chunk of every tile that has so many: `width` tiles side by side, `chunk` Gaussians deep.

    Its slots are `start` + lane * width + column; column j belongs to `TileLists.tiles[j]`.
    """

    start: int
    width: int


@dataclass(frozen=True)
class TileLists:
    """For each tile its Gaussians, front to back, cut into chunks and laid out level by level."""

    grid: TileGrid
    chunk: int
    rows: Int[Tensor, "m"]
    """Which splats are drawn at all, by increasing depth. Their position in here is their rank."""
    ranks: Int[Tensor, "s"]
    """The rank that stands in each slot; m, one past the last, in slots that no Gaussian fills."""
    tiles: Int[Tensor, "a"]
    """The tiles that have any Gaussians, longest list first."""
    levels: tuple[Level, ...]
    slots: Int[Tensor, "q"]
    """Where each (Gaussian, tile) pair stands; the pairs of one Gaussian are neighbours, by rank."""
    bags: Int[Tensor, "m"]
    """Index of each rank's first pair in `slots`."""

    @cached_property
    def fragments(self) -> int:
        """Pixel-Gaussian pairs that the lists hold: an upper bound of what is computed."""
        return self.slots.numel() * self.grid.pixels_per_tile


@dataclass(frozen=True)
class _Pairs:
    """(Gaussian, tile) pairs, sorted by rank."""

    rank: Int[Tensor, "q"]
    tile: Int[Tensor, "q"]
    bags: Int[Tensor, "m"]


def _exclusive_cumsum(counts: Int[Tensor, "n"]) -> Int[Tensor, "n"]:
    return counts.cumsum(0) - counts


def _gsplat_bounds(
    mean: Float[Tensor, "n"], radius: Float[Tensor, "n"]
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
    """First and last pixel, along one axis, of the 16 px tiles that the square of the radius touches."""
    first = (mean / GSPLAT_TILE - radius / GSPLAT_TILE).floor() * GSPLAT_TILE
    last = (mean / GSPLAT_TILE + radius / GSPLAT_TILE).ceil() * GSPLAT_TILE - 1
    return first, last


def _tile_span(
    low: Float[Tensor, "n"],
    high: Float[Tensor, "n"],
    bounds: Sequence[Tensor],
    crop_start: int,
    crop_size: int,
    side: int,
) -> tuple[Int[Tensor, "n"], Int[Tensor, "n"]]:
    """The tiles along one axis with a pixel centre in [low, high], in the crop and in `bounds`.

    Returns (first tile, counted from the image's edge; number of tiles). `bounds` are first and last pixel.
    """
    first = torch.maximum((low - 0.5).ceil(), bounds[0]).clamp(crop_start, crop_start + crop_size)
    last = torch.minimum((high - 0.5).floor(), bounds[1]).clamp(crop_start - 1, crop_start + crop_size - 1)
    first_tile, last_tile = (first / side).floor(), (last / side).floor()
    count = torch.where(first <= last, last_tile - first_tile + 1, 0)
    return first_tile.long(), count.long()


def _candidates(
    splats: Splats, grid: TileGrid, windowed: Tensor | None, window: ZWindow | None
) -> Int[Tensor, "m"]:
    """Splats that can leave a fragment in the crop, by increasing depth; ties by index, as in gsplat."""
    crop, x, y, radii = grid.crop, splats.means2d[:, 0], splats.means2d[:, 1], splats.radii.to(splats.means2d)
    reach = radii + GSPLAT_TILE
    keep = (splats.radii > 0) & (splats.opacities >= MIN_ALPHA)
    keep &= (x + reach > crop.x) & (x - reach < crop.x + crop.width)
    keep &= (y + reach > crop.y) & (y - reach < crop.y + crop.height)
    if window is not None:
        inside = (splats.depths >= window.near.amin()) & (splats.depths < window.far.amax())
        keep &= inside | ~windowed
    rows = keep.nonzero()[:, 0]
    return rows[splats.depths.index_select(0, rows).sort(stable=True).indices]


def _pairs(splats: Splats, grid: TileGrid) -> _Pairs:
    """All pairs of `splats`, whose order is their rank: per row of tiles, those that the ellipse reaches."""
    crop, side = grid.crop, grid.side
    (x, y), radii = splats.means2d.unbind(-1), splats.radii.to(splats.means2d)
    xx, xy, yy = splats.covs2d.unbind(-1)
    # The squared Mahalanobis radius at which alpha falls to 1/255.
    reach = 2.0 * (splats.opacities / MIN_ALPHA).log() + REACH_MARGIN
    half_height = (reach * yy).sqrt()
    y_bounds = _gsplat_bounds(y, radii)
    first_row, n_rows = _tile_span(y - half_height, y + half_height, y_bounds, crop.y, crop.height, side)

    band_start = _exclusive_cumsum(n_rows)
    owner = torch.repeat_interleave(torch.arange(len(splats), device=x.device), n_rows)
    row = torch.arange(owner.numel(), device=x.device) + (first_row - band_start).index_select(0, owner)
    # Within the band's pixel centres, at height v over the mean, the ellipse spans v xy / yy -+ half; its
    # right end is furthest out at v = top of the right flank, its left end at minus that.
    columns = torch.stack((x, y, reach, yy, xy / yy, splats.conics[:, 0], xy * (reach / xx).sqrt()))
    bx, by, breach, byy, slope, precision, flank = columns.index_select(1, owner).unbind(0)
    v_first = row * side + 0.5 - by
    v_last = v_first + (side - 1)
    v_right, v_left = torch.clamp(flank, v_first, v_last), torch.clamp(-flank, v_first, v_last)
    right = bx + v_right * slope + ((breach - v_right * v_right / byy).clamp_min(0) / precision).sqrt()
    left = bx + v_left * slope - ((breach - v_left * v_left / byy).clamp_min(0) / precision).sqrt()
    bounds = [bound.index_select(0, owner) for bound in _gsplat_bounds(x, radii)]
    first_col, n_cols = _tile_span(left, right, bounds, crop.x, crop.width, side)

    pair_start = _exclusive_cumsum(n_cols)
    first_tile = (row - grid.first_row) * grid.cols + (first_col - grid.first_col)
    band = torch.repeat_interleave(torch.arange(owner.numel(), device=x.device), n_cols)
    tile = torch.arange(band.numel(), device=x.device) + (first_tile - pair_start).index_select(0, band)
    # Ranks without a band or without a pair get an empty bag, at the start of the next one.
    bag_of_band = torch.cat((pair_start, pair_start.new_tensor([band.numel()])))
    return _Pairs(owner.index_select(0, band), tile, bag_of_band.index_select(0, band_start))


def _within_window(
    pairs: _Pairs, splats: Splats, grid: TileGrid, windowed: Bool[Tensor, "m"], window: ZWindow
) -> _Pairs:
    """Without the pairs of windowed Gaussians that no pixel of their tile lets through."""
    near = grid.to_tiles(window.near[None], fill=math.inf)[0].amin(dim=0)
    far = grid.to_tiles(window.far[None], fill=-math.inf)[0].amax(dim=0)
    z = splats.depths.index_select(0, pairs.rank)
    keep = (z >= near.index_select(0, pairs.tile)) & (z < far.index_select(0, pairs.tile))
    keep |= ~windowed.index_select(0, pairs.rank)
    kept_before = torch.cat((keep.new_zeros(1, dtype=torch.long), keep.cumsum(0)))
    return _Pairs(pairs.rank[keep], pairs.tile[keep], kept_before[pairs.bags])


def _levels(n_chunks: list[int], chunk: int) -> tuple[Level, ...]:
    """Levels for tiles whose numbers of chunks are given, largest first."""
    levels: list[Level] = []
    start, remaining = 0, len(n_chunks)
    width = remaining
    for depth in range(n_chunks[0] if n_chunks else 0):
        while n_chunks[remaining - 1] <= depth:
            remaining -= 1
        if remaining < SHRINK * width:
            width = remaining
        levels.append(Level(start, width))
        start += chunk * width
    return tuple(levels)


def _lay_out(pairs: _Pairs, rows: Int[Tensor, "m"], grid: TileGrid, chunk: int) -> TileLists:
    n_tiles, n_pairs, device = grid.rows * grid.cols, pairs.tile.numel(), rows.device
    # int32 keys take torch's radix sort, several times faster than comparing int64.
    sorted_tile, order = pairs.tile.int().sort(stable=True)
    counts = torch.bincount(pairs.tile, minlength=n_tiles)
    n_chunks, tiles = ((counts + chunk - 1) // chunk).sort(descending=True, stable=True)
    used = int((n_chunks > 0).sum())
    levels = _levels(n_chunks[:used].tolist(), chunk)
    column = torch.empty_like(tiles)
    column[tiles] = torch.arange(n_tiles, device=device)

    place = torch.arange(n_pairs, device=device) - _exclusive_cumsum(counts).index_select(0, sorted_tile)
    starts = torch.tensor([level.start for level in levels], dtype=torch.long, device=device)
    widths = torch.tensor([level.width for level in levels], dtype=torch.long, device=device)
    depth, lane = torch.div(place, chunk, rounding_mode="floor"), place % chunk
    slot = (
        starts.index_select(0, depth)
        + lane * widths.index_select(0, depth)
        + column.index_select(0, sorted_tile)
    )

    n_slots = levels[-1].start + chunk * levels[-1].width if levels else 0
    ranks = torch.full((n_slots,), len(rows), dtype=torch.long, device=device)
    ranks.index_copy_(0, slot, pairs.rank.index_select(0, order))
    slots = torch.empty_like(slot).index_copy_(0, order, slot)
    return TileLists(grid, chunk, rows, ranks, tiles[:used], levels, slots, pairs.bags)


@torch.no_grad()
def bin_splats(
    splats: Splats,
    grid: TileGrid,
    chunk: int,
    *,
    windowed: Bool[Tensor, "n"] | None = None,
    window: ZWindow | None = None,
) -> TileLists:
    """Lists of the Gaussians that each tile of the grid draws.

    Args:
        chunk: Gaussians per chunk; lists are padded to multiples of it.
        windowed: which splats `window` masks. Given together with `window` or not at all.
    """
    rows = _candidates(splats, grid, windowed, window)
    ranked = Splats(*(getattr(splats, name).index_select(0, rows) for name in Splats.__dataclass_fields__))
    pairs = _pairs(ranked, grid)
    if window is not None:
        pairs = _within_window(pairs, ranked, grid, windowed[rows], window)
    return _lay_out(pairs, rows, grid, chunk)
