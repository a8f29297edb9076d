"""Which Gaussians each small tile has to draw, in what order: the lists that the compositing kernels walk.

gsplat draws a Gaussian on every pixel of every 16 px tile that the square of its radius touches, where its
alpha reaches 1/255. Here tiles are smaller and lists tighter: a (Gaussian, tile) pair is kept only if the
alpha >= 1/255 ellipse reaches the tile's rows of pixel centres, and gsplat's rectangle holds the tile. No
fragment is lost by that, and none is added.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, Int32
from torch import Tensor

from abcd_ns.engine.render.primitive import SPLATS, Primitive
from abcd_ns.engine.render.projection import Splats
from abcd_ns.engine.render.splat_kernels import DEPTH, TILE_COLUMNS
from abcd_ns.engine.render.tile_grid import TileSheet
from abcd_ns.engine.render.z_window import ZWindow, ends_of

SHRINK = 0.875
"""A level is narrowed once fewer than this share of its tiles still have Gaussians to draw."""
WORTH_RADIX, RADIX = 4096, 32_768
"""Keys that are padded to so many before they are sorted, see `sorted_keys`."""
TILES_AT_ONCE = 2400
"""Tiles side by side in a level, at most: what the kernels hold of more would not fit into a core's cache."""


@dataclass(frozen=True)
class Level:
    """The n-th chunk of every tile that has so many: `width` tiles side by side, `chunk` Gaussians deep.

    Its slots are `start` + lane * width + column; column j belongs to `TileLists.tiles[first + j]`.
    """

    start: int
    width: int
    first: int


@dataclass(frozen=True)
class TileLists:
    """For each tile its Gaussians, front to back, cut into chunks and laid out level by level.

    Tiles with lists of like length are one group, drawn to its end before the next one is begun.
    """

    sheet: TileSheet
    chunk: int
    rows: Int[Tensor, "m"]
    """Which splats are drawn at all, by increasing depth. Their position in here is their rank."""
    ranks: Int[Tensor, "s"]
    """The rank that stands in each slot; m, one past the last, in slots that no Gaussian fills."""
    tiles: Int[Tensor, "a"]
    """The tiles that have any Gaussians, longest list first."""
    groups: tuple[tuple[Level, ...], ...]
    """The levels of each group of tiles; a group's first level is as wide as the group."""
    slots: Int[Tensor, "q"]
    """Where each (Gaussian, tile) pair stands; the pairs of one Gaussian are neighbours, by rank."""
    bags: Int[Tensor, "m"]
    """Index of each rank's first pair in `slots`."""


@dataclass(frozen=True)
class _Pairs:
    """(Gaussian, tile) pairs, sorted by rank."""

    rank: Int[Tensor, "q"]
    tile: Int[Tensor, "q"]
    bags: Int[Tensor, "m"]


def _exclusive_cumsum(counts: Int[Tensor, "n"]) -> Int[Tensor, "n"]:
    return counts.cumsum(0) - counts


def _pairs(
    spans: Int[Tensor, "2 m"],
    bands: Float[Tensor, "b m"],
    places: Int[Tensor, "2 m"],
    built: bool,
) -> _Pairs:
    """All pairs of ranked Gaussians: per row of tiles, those that the ellipse reaches.

    Args:
        spans: first row and number of rows of tiles.
        bands: see splat_kernels.
        places: of each Gaussian's grid, see TileSheet.
    """
    first_row, n_rows = spans.unbind(0)
    band_start = _exclusive_cumsum(n_rows)
    owner = torch.repeat_interleave(n_rows)
    row = _count(owner) + (first_row - band_start).index_select(0, owner)
    (spans,) = TILE_COLUMNS(bands.index_select(1, owner), row.to(bands), built=built)
    first_col, n_cols = spans.long().unbind(0)

    pair_start = _exclusive_cumsum(n_cols)
    base, cols = places.index_select(1, owner).unbind(0)
    first_tile = base + cols * row + first_col
    band = torch.repeat_interleave(n_cols)
    tile = _count(band) + (first_tile - pair_start).index_select(0, band)
    # Ranks without a band or without a pair get an empty bag, at the start of the next one.
    bag_of_band = torch.cat((pair_start, pair_start.new_tensor([band.numel()])))
    return _Pairs(owner.index_select(0, band), tile, bag_of_band.index_select(0, band_start))


def _count(items: Tensor) -> Int[Tensor, "n"]:
    return torch.arange(items.numel(), device=items.device)


def _only(pairs: _Pairs, keep: Bool[Tensor, "q"]) -> _Pairs:
    """Some of the pairs."""
    kept_before = torch.cat((keep.new_zeros(1, dtype=torch.long), keep.cumsum(0)))
    kept = keep.nonzero()[:, 0]
    rank, tile = pairs.rank.index_select(0, kept), pairs.tile.index_select(0, kept)
    return _Pairs(rank, tile, kept_before.index_select(0, pairs.bags))


def _levels(n_chunks: list[int], chunk: int, start: int, first: int) -> tuple[Level, ...]:
    """Levels for tiles whose numbers of chunks are given, largest first.

    Args:
        start: slot of the first level.
        first: of the tiles, see Level.
    """
    levels: list[Level] = []
    width = remaining = len(n_chunks)
    for depth in range(n_chunks[0]):
        while n_chunks[remaining - 1] <= depth:
            remaining -= 1
        if remaining < SHRINK * width:
            width = remaining
        levels.append(Level(start, width, first))
        start += chunk * width
    return tuple(levels)


def _groups(n_chunks: list[int], chunk: int) -> tuple[int, tuple[tuple[Level, ...], ...]]:
    """(tiles of a group, the last one's excepted; the levels of each group)."""
    size = math.ceil(len(n_chunks) / max(math.ceil(len(n_chunks) / TILES_AT_ONCE), 1))
    groups: list[tuple[Level, ...]] = []
    start = 0
    for first in range(0, len(n_chunks), max(size, 1)):
        groups.append(_levels(n_chunks[first : first + size], chunk, start, first))
        start = groups[-1][-1].start + chunk * groups[-1][-1].width
    return size, tuple(groups)


def _lay_out(pairs: _Pairs, rows: Int[Tensor, "m"], sheet: TileSheet, chunk: int) -> TileLists:
    n_tiles, n_pairs, device = sheet.tiles, pairs.tile.numel(), rows.device
    sorted_tile, order = by_tile(pairs.tile, n_tiles)
    counts = torch.bincount(pairs.tile, minlength=n_tiles)
    n_chunks, tiles = ((counts + chunk - 1) // chunk).sort(descending=True, stable=True)
    used = int((n_chunks > 0).sum())
    size, groups = _groups(n_chunks[:used].tolist(), chunk)
    levels = [level for group in groups for level in group]
    column = torch.empty_like(tiles)
    column[tiles] = torch.arange(n_tiles, device=device)

    place = torch.arange(n_pairs, device=device) - _exclusive_cumsum(counts).index_select(0, sorted_tile)
    starts = torch.tensor([level.start for level in levels], dtype=torch.long, device=device)
    widths = torch.tensor([level.width for level in levels], dtype=torch.long, device=device)
    before = torch.tensor([0, *map(len, groups)], dtype=torch.long, device=device).cumsum(0)
    column = column.index_select(0, sorted_tile)
    group = torch.div(column, max(size, 1), rounding_mode="floor")
    level = before.index_select(0, group) + torch.div(place, chunk, rounding_mode="floor")
    across = (place % chunk) * widths.index_select(0, level)
    slot = starts.index_select(0, level) + across + column - group * size

    n_slots = levels[-1].start + chunk * levels[-1].width if levels else 0
    ranks = torch.full((n_slots,), len(rows), dtype=torch.long, device=device)
    ranks.index_copy_(0, slot, pairs.rank.index_select(0, order))
    slots = torch.empty_like(slot).index_copy_(0, order, slot)
    return TileLists(sheet, chunk, rows, ranks, tiles[:used], groups, slots, pairs.bags)


def sorted_keys(keys: Int[Tensor, "n"]) -> tuple[Int[Tensor, "n"], Int[Tensor, "n"]]:
    """The keys in ascending order, and where each was; ties stay as they were.

    On a CPU torch sorts that many integers by radix, ten times faster than it compares fewer or floats.
    """
    count = len(keys)
    if keys.device.type == "cpu" and WORTH_RADIX < count < RADIX:
        keys = F.pad(keys, (0, RADIX - count), value=torch.iinfo(keys.dtype).max)
    found, order = keys.sort(stable=True)
    return found[:count], order[:count]


def by_tile(tile: Int[Tensor, "q"], tiles: int) -> tuple[Int32[Tensor, "q"], Int[Tensor, "q"]]:
    """Pairs' tiles in ascending order, and where each was; ties stay as they were.

    Args:
        tiles: that there are.
    """
    # A radix sort goes through all bytes that a key may have.
    keys = tile.to(torch.int16 if tiles <= torch.iinfo(torch.int16).max else torch.int32)
    found, order = sorted_keys(keys)
    return found.int(), order


def by_depth(depths: Float[Tensor, "n"]) -> tuple[Float[Tensor, "n"], Int[Tensor, "n"]]:
    """The depths in ascending order, and where each was; ties stay as they were."""
    if depths.dtype != torch.float32:
        return tuple(depths.sort(stable=True))
    # In front of a camera they are positive: floats in the order of their bits.
    found, order = sorted_keys(depths.view(torch.int32))
    return found.view(torch.float32), order


@dataclass(frozen=True)
class Candidates:
    """All (Gaussian, tile) pairs of a drawing, before any window."""

    sheet: TileSheet
    rows: Int[Tensor, "m"]
    """Which splats may be drawn, by increasing depth; ties by index, as in gsplat."""
    depths: Float[Tensor, "m"]
    """Theirs."""
    pairs: _Pairs

    def lists(self, chunk: int) -> TileLists:
        """The lists of the Gaussians that each tile draws.

        Args:
            chunk: Gaussians per chunk; lists are padded to multiples of it.
        """
        return _lay_out(self.pairs, self.rows, self.sheet, chunk)

    def within(
        self, windows: Sequence[ZWindow | None], masked: Bool[Tensor, "n"] | None = None
    ) -> "Candidates":
        """Without the pairs that lie outside of their window.

        Args:
            windows: of each of the sheet's grids; None masks nothing there.
            masked: which splats the windows apply to; None for all.
        """
        inside = self._holds(windows)
        if masked is not None:
            inside |= ~masked.index_select(0, self.rows.index_select(0, self.pairs.rank))
        return replace(self, pairs=_only(self.pairs, inside))

    @property
    def z(self) -> Float[Tensor, "q"]:
        """Camera z of each pair's Gaussian."""
        return self.depths.index_select(0, self.pairs.rank)

    @property
    def members(self) -> Int[Tensor, "k"]:
        """Indices of the splats that any tile may draw; ascending."""
        return self.rows.index_select(0, self.pairs.rank.unique_consecutive()).sort().values

    def _holds(self, windows: Sequence[ZWindow | None]) -> Bool[Tensor, "q"]:
        pairs = zip(windows, self.sheet.grids, strict=True)
        ends = [ends_of(window, grid, self.depths) for window, grid in pairs]
        near, far = torch.cat(ends, dim=1).index_select(1, self.pairs.tile)
        return (self.z >= near) & (self.z < far)


@torch.no_grad()
def find_candidates(
    splats: Splats,
    grid_of: Int[Tensor, "n"],
    sheet: TileSheet,
    *,
    built: bool = True,
    primitive: Primitive = SPLATS,
) -> Candidates:
    """What the tiles may have to draw.

    Args:
        grid_of: which of the sheet's grids each splat belongs to.
        built: use machine code where it is there.
    """
    planes = splats.planes.detach()
    spans, bands = primitive.tile_rows(planes, sheet.numbers(planes).index_select(1, grid_of), built=built)
    rows = (spans[1] > 0).nonzero()[:, 0]
    depths, order = by_depth(planes[DEPTH].index_select(0, rows))
    rows = rows.index_select(0, order)
    spans, bands = spans.index_select(1, rows).long(), bands.index_select(1, rows)
    places = sheet.places(planes.device).index_select(1, grid_of.index_select(0, rows))
    return Candidates(sheet, rows, depths, _pairs(spans, bands, places, built))
