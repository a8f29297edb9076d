"""Lists of tiles and compositing in plain torch: the reference of kernels/cpp/drawing.h.

A pair is a Gaussian and a tile that may draw it. The state of a pixel is its transmittance T and what was
added up; compositing stops for good at the fragment that would bring T to 1e-4 or below.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from abcd_ns.engine.render import splat_kernels as splat
from abcd_ns.engine.render import surfel_kernels as surfel
from abcd_ns.engine.render.primitive import Primitive
from abcd_ns.engine.render.residual_sums import about, moments
from abcd_ns.engine.render.splat_kernels import DEPTH, GSPLAT_TILE, MIN_ALPHA, REACH_MARGIN, X, Y
from abcd_ns.engine.render.tile_grid import TileGrid
from abcd_ns.engine.render.z_window import ZWindow, ends_of
from abcd_ns.engine.types import Crop

MAX_ALPHA = 0.999
"""Alphas are clamped to this."""
MIN_TRANSMITTANCE = 1e-4
"""The fragment after which T would be at most this, and all behind it, are not drawn."""
FRAGMENTS_AT_ONCE = 1 << 21
"""Of a group of tiles, at most, or of one tile: what is held while gradients are taken."""


@dataclass(frozen=True)
class Lists:
    """The pairs of some pictures, sorted by tile, then by depth, then by column."""

    grids: tuple[TileGrid, ...]
    """Of the pictures; tiles are numbered one grid after the other."""
    starts: tuple[int, ...]
    """The number of each grid's first tile, and one past the last."""
    tile: Int[Tensor, "q"]
    column: Int[Tensor, "q"]
    z: Float[Tensor, "q"]

    def within(self, windows: Sequence[ZWindow | None], masked: Bool[Tensor, "n"] | None = None) -> "Lists":
        """Without the pairs outside of their picture's window; of the `masked` columns only, or of all."""
        ends = [ends_of(window, grid, self.z) for window, grid in zip(windows, self.grids, strict=True)]
        near, far = torch.cat(ends, dim=1).index_select(1, self.tile)
        keep = (self.z >= near) & (self.z < far)
        if masked is not None:
            keep |= ~masked[self.column]
        return replace(self, tile=self.tile[keep], column=self.column[keep], z=self.z[keep])


def find_lists(
    planes: Float[Tensor, "r n"],
    picture: Int[Tensor, "n"],
    crops: Sequence[Crop],
    side: int,
    primitive: Primitive,
) -> Lists:
    """Every pair that may hold a fragment: the tile is in gsplat's rectangle of 16 px tiles around the middle
    and, of splats, reaches into the box around the ellipse of alpha = 1/255.

    Args:
        planes: see Splats.
        picture: which one each column belongs to.
    """
    planes, grids = planes.detach(), tuple(TileGrid(crop, side) for crop in crops)
    starts = [0]
    for grid in grids:
        starts.append(starts[-1] + grid.tiles)
    bounds, opacity, radius = planes[[X, Y]], planes[-8], planes[-1]
    low = ((bounds - radius) / GSPLAT_TILE).floor() * GSPLAT_TILE
    high = ((bounds + radius) / GSPLAT_TILE).ceil() * GSPLAT_TILE - 1
    if primitive.name == "3dgs":
        reach = 2.0 * (opacity / MIN_ALPHA).log().clamp_min(0) + REACH_MARGIN
        half = (reach * planes[[splat.COV_XX, splat.COV_YY]]).sqrt()
        low, high = low.maximum((bounds - half - 0.5).ceil()), high.minimum((bounds + half - 0.5).floor())
    ends = planes.new_tensor([[c.x, c.y, c.x + c.width - 1, c.y + c.height - 1] for c in crops]).T[:, picture]
    low, high = low.maximum(ends[:2]), high.minimum(ends[2:])
    drawn = (low <= high).all(dim=0) & (radius > 0) & (opacity >= MIN_ALPHA)
    rows = drawn.nonzero()[:, 0]
    rows = rows[planes[DEPTH][rows].sort(stable=True).indices]
    first, last = ((value[:, rows] / side).floor().long() for value in (low, high))
    cols, lines = last - first + 1
    owner = torch.repeat_interleave(cols * lines)
    within = torch.arange(len(owner), device=owner.device) - ((cols * lines).cumsum(0) - cols * lines)[owner]
    numbers = [(s - g.first_row * g.cols - g.first_col, g.cols) for s, g in zip(starts, grids, strict=False)]
    base, width = torch.tensor(numbers, device=owner.device).T[:, picture[rows]]
    line = first[1][owner] + torch.div(within, cols[owner], rounding_mode="floor")
    tile = base[owner] + width[owner] * line + first[0][owner] + within % cols[owner]
    tile, order = tile.sort(stable=True)
    column = rows[owner[order]]
    return Lists(grids, tuple(starts), tile, column, planes[DEPTH][column])


class _Group(NamedTuple):
    """Some tiles with lists of like length, padded to the longest: k pairs for each of t tiles."""

    tiles: Int[Tensor, "t"]
    pairs: Int[Tensor, "t k"]
    is_pair: Bool[Tensor, "t k"]
    x: Float[Tensor, "t p"]
    """Of pixel centres."""
    y: Float[Tensor, "t p"]
    inside: Bool[Tensor, "t p"]


def _groups(lists: Lists) -> Iterator[_Group]:
    """All tiles with any pairs, longest lists first."""
    counts = torch.bincount(lists.tile, minlength=lists.starts[-1])
    first = counts.cumsum(0) - counts
    order = counts.sort(descending=True, stable=True).indices
    x, y, inside = (torch.cat(parts) for parts in zip(*map(_pixels, lists.grids), strict=True))
    x, y, inside = (values.to(lists.tile.device) for values in (x, y, inside))
    lengths, taken = counts[order].tolist(), 0
    while taken < len(lengths) and lengths[taken]:
        longest = lengths[taken]
        tiles = order[taken : taken + max(FRAGMENTS_AT_ONCE // (longest * x.shape[1]), 1)]
        tiles = tiles[counts[tiles] > 0]
        taken += len(tiles)
        places = torch.arange(longest, device=tiles.device)
        is_pair = places < counts[tiles][:, None]
        pairs = first[tiles][:, None] + torch.where(is_pair, places, 0)
        yield _Group(tiles, pairs, is_pair, x[tiles].to(lists.z), y[tiles].to(lists.z), inside[tiles])


def _pixels(grid: TileGrid) -> tuple[Tensor, Tensor, Tensor]:
    """(x, y) of the pixel centres of each tile, and which of them the crop holds, [t, p] each."""
    pixel, (x, y) = torch.arange(grid.pixels_per_tile), grid.origins(torch.arange(grid.tiles), torch.float64)
    x = x[:, None] + pixel % grid.side + 0.5
    y = y[:, None] + torch.div(pixel, grid.side, rounding_mode="floor") + 0.5
    crop = grid.crop
    inside = (x > crop.x) & (x < crop.x + crop.width) & (y > crop.y) & (y < crop.y + crop.height)
    return x, y, inside


def _alphas(rows: Float[Tensor, "d t k"], group: _Group, primitive: Primitive) -> Float[Tensor, "t k p"]:
    """min(0.999, opacity exp(-sigma)) of each fragment, 0 where it is not drawn."""
    center = primitive.center
    dx = rows[center, ..., None] - group.x[:, None]
    dy = rows[center + 1, ..., None] - group.y[:, None]
    if primitive.name == "3dgs":
        xx, xy, yy = rows[splat.CONIC_XX : splat.CONIC_YY + 1, ..., None]
        sigma = dx * (0.5 * xx * dx + xy * dy) + 0.5 * yy * dy * dy
        drawn = sigma >= 0
    else:
        sigma, drawn = _surfel_sigma(rows[..., None], dx, dy)
    opacity = rows[-4, ..., None]
    alphas = (opacity * torch.exp(-sigma)).clamp_max(MAX_ALPHA)
    return torch.where(drawn & (alphas >= MIN_ALPHA) & group.is_pair[..., None], alphas, 0.0)


def _surfel_sigma(rows: Tensor, dx: Tensor, dy: Tensor) -> tuple[Tensor, Tensor]:
    """Where a pixel's ray meets the disc, or gsplat's low-pass filter around its box's middle. As in gsplat,
    rays within the disc's plane meet nothing."""
    a, b, c, d, e, f = surfel.relative_matrix(rows.unbind(0))
    w = (a * d - b * c) - dx * (f * c - e * d) - dy * (e * b - f * a)
    meets = w != 0
    inverse = 1.0 / torch.where(meets, w, 1.0)
    s, t = (b * dy - d * dx) * inverse, (c * dx - a * dy) * inverse
    box_x, box_y = dx + (rows[X] - rows[surfel.U]), dy + (rows[Y] - rows[surfel.V])
    on_disc, filtered = 0.5 * (s * s + t * t), box_x * box_x + box_y * box_y
    is_disc = on_disc <= filtered
    # What is divided by next to nothing may be infinite where the filter counts.
    return torch.where(is_disc, torch.where(is_disc, on_disc, 0.0), filtered), meets


def _advance(left: Tensor, live: Tensor, alpha: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """One fragment further: transmittance, which pixels go on, and the fragment's weight alpha T."""
    next_left = left * (1.0 - alpha)
    live = live & (next_left > MIN_TRANSMITTANCE)
    return torch.where(live, next_left, left), live, torch.where(live, alpha * left, 0.0)


def composite(rows: Float[Tensor, "d n"], lists: Lists, primitive: Primitive) -> list[Float[Tensor, "5 h w"]]:
    """Transmittance, colour and depth of each picture; differentiable in the rows that take gradients."""
    tiled = rows.new_zeros((5, lists.starts[-1], lists.grids[0].pixels_per_tile))
    tiled[0] = 1.0
    tiled = tiled + rows[:, :0].sum()  # in the graph, even if nothing is drawn
    takes = rows.requires_grad and torch.is_grad_enabled()
    for group in _groups(lists):
        columns = lists.column[group.pairs]
        given = (rows, columns, group, primitive)
        draw = partial(checkpoint, _composite_group, use_reentrant=False) if takes else _composite_group
        drawn = draw(*given)
        tiled = tiled.index_copy(1, group.tiles, drawn)
    parts = tiled.transpose(1, 2).split([grid.tiles for grid in lists.grids], dim=2)
    return [grid.to_image(part) for grid, part in zip(lists.grids, parts, strict=True)]


def _composite_group(
    rows: Tensor, columns: Tensor, group: _Group, primitive: Primitive
) -> Float[Tensor, "5 t p"]:
    chosen = rows.index_select(1, columns.flatten()).view(len(rows), *columns.shape)
    alphas = _alphas(chosen, group, primitive)
    left, live = torch.ones_like(group.x), group.inside
    sums = [torch.zeros_like(left) for _ in range(4)]
    values = (*chosen[-3:], chosen[DEPTH])
    for k in range(columns.shape[1]):
        left, live, weight = _advance(left, live, alphas[:, k])
        sums = [so_far + weight * value[:, k, None] for so_far, value in zip(sums, values, strict=True)]
    return torch.stack((left, *sums))


def residual_sums(
    rows: Float[Tensor, "d n"],
    lists: Lists,
    primitive: Primitive,
    residuals: Sequence[Float[Tensor, "_h _w 4"]],
) -> Float[Tensor, "n 10"]:
    """See ResidualSums, of each column: gradients by colours, which stand for them, and by the depth."""
    leaf = torch.zeros_like(rows[:4])
    asked = [moments(r, grid.crop).to(rows) for r, grid in zip(residuals, lists.grids, strict=True)]
    with torch.enable_grad():
        *colors, depth = leaf.requires_grad_()
        painted = torch.stack([*rows[:DEPTH], depth, *rows[DEPTH + 1 : -3], *colors])
        drawn = [image[1:] for image in composite(painted, lists, primitive)]
    found = []
    for k in (1, 4, 7):
        upstream = [torch.cat((part[..., k : k + 3], part[..., :1]), dim=-1) for part in asked]
        upstream = [part.permute(2, 0, 1) for part in upstream]
        found.append(torch.autograd.grad(drawn, leaf, upstream, retain_graph=k < 7)[0])
    sums = torch.cat((found[0][3:], *(part[:3] for part in found))).T
    return about(sums, rows[primitive.center : primitive.center + 2].T)


@torch.no_grad()
def pair_weights(rows: Float[Tensor, "d n"], lists: Lists, primitive: Primitive) -> Float[Tensor, "q"]:
    """For each pair the sum of the Gaussian's weight alpha T over the tile's pixels."""
    found = torch.zeros_like(lists.z)
    for group in _groups(lists):
        alphas = _alphas(rows[:, lists.column[group.pairs]], group, primitive)
        left, live = torch.ones_like(group.x), group.inside
        for k in range(group.pairs.shape[1]):
            left, live, weight = _advance(left, live, alphas[:, k])
            held = group.is_pair[:, k]
            found[group.pairs[held, k]] = weight[held].sum(dim=1)
    return found


@torch.no_grad()
def deepen(
    rows: Float[Tensor, "d n"], lists: Lists, primitive: Primitive, state: Float[Tensor, "2 h w"]
) -> Float[Tensor, "2 h w"]:
    """Transmittance, negative where it is a half or less, and the depth of the last fragment that is drawn
    while it is more: of the one picture, behind what `state` says of what is in front."""
    (grid,) = lists.grids
    tiled = grid.to_tiles(state, fill=-1.0).transpose(1, 2).contiguous()
    for group in _groups(lists):
        columns = lists.column[group.pairs]
        alphas = _alphas(rows[:, columns], group, primitive)
        left, depth = tiled[:, group.tiles]
        for k in range(columns.shape[1]):
            passes = left > 0.5
            depth = torch.where(passes & (alphas[:, k] > 0), rows[DEPTH, columns[:, k], None], depth)
            left = torch.where(passes, left * (1.0 - alphas[:, k]), left)
        tiled[:, group.tiles] = torch.stack((torch.where(left > 0.5, left, -left.abs()), depth))
    return grid.to_image(tiled.transpose(1, 2))
