"""Which Gaussians each small tile has to draw, in what order: the lists that the compositing kernels walk.

gsplat draws a Gaussian on every pixel of every 16 px tile that the square of its radius touches, where its
alpha reaches 1/255. Here tiles are smaller and lists tighter: a (Gaussian, tile) pair is kept only if the
alpha >= 1/255 ellipse reaches the tile's rows of pixel centres, and gsplat's rectangle holds the tile. No
fragment is lost by that, and none is added.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from abcd_ns.engine.rasterizer.base import ZWindow
from abcd_ns.engine.rasterizer.projection import Splats
from abcd_ns.engine.rasterizer.splat_kernels import (
    DEPTH,
    GSPLAT_TILE,
    MIN_ALPHA,
    OPACITY,
    RADIUS,
    TILE_COLUMNS,
    TILE_ROWS,
    X,
    Y,
)
from abcd_ns.engine.rasterizer.tile_grid import TileGrid

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


def _candidates(splats: Splats, grid: TileGrid, inside: Tensor | None) -> Int[Tensor, "m"]:
    """Splats that can leave a fragment in the crop, by increasing depth; ties by index, as in gsplat."""
    crop, planes = grid.crop, splats.planes
    x, y, depth, radius = planes[X], planes[Y], planes[DEPTH], planes[RADIUS]
    reach = radius + GSPLAT_TILE
    keep = (radius > 0) & (planes[OPACITY] >= MIN_ALPHA)
    keep &= (x + reach > crop.x) & (x - reach < crop.x + crop.width)
    keep &= (y + reach > crop.y) & (y - reach < crop.y + crop.height)
    if inside is not None:
        keep &= inside
    rows = keep.nonzero()[:, 0]
    return rows.index_select(0, depth.index_select(0, rows).sort(stable=True).indices)


def _pairs(splats: Splats, grid: TileGrid, built: bool) -> _Pairs:
    """All pairs of `splats`, whose order is their rank: per row of tiles, those that the ellipse reaches."""
    crop = grid.crop
    numbers = splats.planes.new_tensor([crop.x, crop.y, crop.width, crop.height, grid.side])
    spans, bands = TILE_ROWS(splats.planes, numbers, built=built)
    first_row, n_rows = spans.long().unbind(0)
    band_start = _exclusive_cumsum(n_rows)
    owner = torch.repeat_interleave(n_rows)
    row = _count(owner) + (first_row - band_start).index_select(0, owner)
    columns = bands.index_select(1, owner)
    (spans,) = TILE_COLUMNS(columns, row.to(columns), numbers, built=built)
    first_col, n_cols = spans.long().unbind(0)

    pair_start = _exclusive_cumsum(n_cols)
    first_tile = (row - grid.first_row) * grid.cols + (first_col - grid.first_col)
    band = torch.repeat_interleave(n_cols)
    tile = _count(band) + (first_tile - pair_start).index_select(0, band)
    # Ranks without a band or without a pair get an empty bag, at the start of the next one.
    bag_of_band = torch.cat((pair_start, pair_start.new_tensor([band.numel()])))
    return _Pairs(owner.index_select(0, band), tile, bag_of_band.index_select(0, band_start))


def _count(items: Tensor) -> Int[Tensor, "n"]:
    return torch.arange(items.numel(), device=items.device)


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
    kept = keep.nonzero()[:, 0]
    rank, tile = pairs.rank.index_select(0, kept), pairs.tile.index_select(0, kept)
    return _Pairs(rank, tile, kept_before.index_select(0, pairs.bags))


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


@dataclass(frozen=True)
class Candidates:
    """All (Gaussian, tile) pairs of a drawing, before any window."""

    grid: TileGrid
    rows: Int[Tensor, "m"]
    """Which splats may be drawn, by increasing depth."""
    ranked: Splats
    """These, in this order."""
    pairs: _Pairs

    def lists(
        self, chunk: int, windowed: Bool[Tensor, "n"] | None = None, window: ZWindow | None = None
    ) -> TileLists:
        """As drawn through a window: see bin_splats."""
        pairs = self.pairs
        if window is not None:
            pairs = _within_window(pairs, self.ranked, self.grid, windowed[self.rows], window)
        return _lay_out(pairs, self.rows, self.grid, chunk)


@torch.no_grad()
def find_candidates(
    splats: Splats, grid: TileGrid, *, inside: Bool[Tensor, "n"] | None = None, built: bool = True
) -> Candidates:
    """What the tiles of the grid may have to draw.

    Args:
        inside: leave out the others.
        built: use machine code where it is there.
    """
    rows = _candidates(splats, grid, inside)
    ranked = splats[rows]
    return Candidates(grid, rows, ranked, _pairs(ranked, grid, built))


@torch.no_grad()
def bin_splats(
    splats: Splats,
    grid: TileGrid,
    chunk: int,
    *,
    windowed: Bool[Tensor, "n"] | None = None,
    window: ZWindow | None = None,
    built: bool = True,
) -> TileLists:
    """Lists of the Gaussians that each tile of the grid draws.

    Args:
        chunk: Gaussians per chunk; lists are padded to multiples of it.
        windowed: which splats `window` masks. Given together with `window` or not at all.
        built: use machine code where it is there.
    """
    inside = None
    if window is not None:
        depths = splats.depths
        inside = (depths >= window.near.amin()) & (depths < window.far.amax()) | ~windowed
    return find_candidates(splats, grid, inside=inside, built=built).lists(chunk, windowed, window)
