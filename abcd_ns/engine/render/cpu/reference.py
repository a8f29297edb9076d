"""Lists of tiles and compositing in plain torch, for any device and dtype: the reference of native.Lists.

A pair is a Gaussian and a tile that may draw it. The state of a pixel is its transmittance T and what was
added up; compositing stops for good at the fragment that would bring T to 1e-4 or below.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from abcd_ns.engine.render import splat_kernels as kernels
from abcd_ns.engine.render.base import SUMS, ResidualSums, about, moments
from abcd_ns.engine.render.cpu.native import Part, Pictures, Windows
from abcd_ns.engine.render.projection import Primitive
from abcd_ns.engine.render.splat_kernels import DEPTH, GSPLAT_TILE, MAX_ALPHA, MIN_ALPHA, REACH_MARGIN, X, Y
from abcd_ns.engine.render.z_window import TileGrid, ends_of, showing
from abcd_ns.engine.transfer import finest
from abcd_ns.engine.types import Crop

MIN_TRANSMITTANCE = 1e-4
"""The fragment after which T would be at most this, and all behind it, are not drawn."""

Step = Callable[[Tensor, Float[Tensor, "d t 1"], Float[Tensor, "2 t p"], Primitive], Tensor]
"""Takes the state [c t p] of some tiles, the rows of the Gaussian that is next in each, and the pixels'
centres; returns the state behind that Gaussian."""


@dataclass(frozen=True)
class Lists:
    """The pairs of some pictures, sorted by tile, then by depth, then by column. See native.Lists."""

    primitive: Primitive
    grids: tuple[TileGrid, ...]
    """Of the pictures; tiles are numbered one grid after the other."""
    planes: Float[Tensor, "r n"]
    """Of all parts, without gradients; see Splats."""
    tile: Int[Tensor, "q"]
    column: Int[Tensor, "q"]

    @property
    def z(self) -> Float[Tensor, "q"]:
        """Camera z of each pair's Gaussian."""
        return self.planes[DEPTH].index_select(0, self.column)

    def draw(self, windows: Windows = ()) -> Pictures:
        lists = self.within(windows) if windows else self
        return lists._composited(self.planes[: self.primitive.graded])

    def composite(
        self, planes: Float[Tensor, "v r n"], means2d: Float[Tensor, "v n 2"], weights: Tensor | None
    ) -> tuple[Pictures, ResidualSums]:
        own = list(planes[:, : self.primitive.graded].unbind(1))
        others = self.planes[: self.primitive.graded, own[0].numel() :]
        # The leaves add nothing, and get the gradients.
        for axis in range(2):
            row = self.primitive.center + axis
            own[row] = own[row] + (means2d - means2d.detach())[..., axis]
        if weights is not None:
            own[DEPTH] = weights
            others = others.clone()
            others[DEPTH] = 0.0
        rows = torch.cat((torch.stack(own).flatten(1), others), dim=1)
        return self._composited(rows), ResidualSums(partial(self._residual_sums, planes.detach()))

    def kept_ids(self, windows: Windows) -> Bool[Tensor, "n"]:
        found = torch.zeros(self.planes.shape[1], dtype=torch.bool, device=self.planes.device)
        return found.index_fill(0, self.within(windows).column, True)

    @torch.no_grad()
    def shown(self, visible: float) -> list[Float[Tensor, "2 _t"]]:
        found, weights = [], self._pair_weights()
        for start, grid in zip(_first_tiles(self.grids), self.grids, strict=True):
            own = (self.tile >= start) & (self.tile < start + grid.tiles)
            pairs = (self.tile[own] - start, self.z[own], weights[own])
            found.append(showing(grid.pixels(self.tile.device)[None], *pairs, visible).flatten(1))
        return found

    def deepen(self, windows: Windows, left: Float[Tensor, "h w"], depth: Float[Tensor, "h w"]) -> None:
        ((found, behind),) = self.within(windows)._walked(
            self.planes[: self.primitive.graded], [torch.stack((left, depth))], _deepened
        )
        left.copy_(found)
        depth.copy_(behind)

    def within(self, windows: Windows, masked: Bool[Tensor, "n"] | None = None) -> "Lists":
        """Without the pairs outside of their picture's window; of the `masked` columns only, or of all."""
        ends = [ends_of(window, grid, self.planes) for window, grid in zip(windows, self.grids, strict=True)]
        near, far = torch.cat(ends, dim=1).index_select(1, self.tile)
        keep = (self.z >= near) & (self.z < far)
        if masked is not None:
            keep |= ~masked[self.column]
        return replace(self, tile=self.tile[keep], column=self.column[keep])

    def _composited(self, rows: Float[Tensor, "d n"]) -> Pictures:
        """Pictures, differentiable in the rows that take gradients."""
        images = self._blended(torch.cat((rows, rows[DEPTH : DEPTH + 1])))
        return [(image[1:4].permute(1, 2, 0), image[0], image[4]) for image in images]

    def _blended(self, rows: Float[Tensor, "d n"]) -> list[Float[Tensor, "c _h _w"]]:
        """Transmittance, then the sums of weight x value for each of the rows that follow the opacity."""
        values = len(rows) - self.primitive.graded + 3
        sizes = [(grid.crop.height, grid.crop.width) for grid in self.grids]
        images = [torch.cat((rows.new_ones(1, *size), rows.new_zeros(values, *size))) for size in sizes]
        return [torch.cat((i[:1].abs(), i[1:])) for i in self._walked(rows, images, _blend)]

    def _residual_sums(
        self, planes: Float[Tensor, "v r n"], residuals: Sequence[Float[Tensor, "_h _w 4"]]
    ) -> Float[Tensor, "v n 10"]:
        """See ResidualSums: gradients by values that are composited in the colours' place."""
        center, shapes = self.primitive.center, self.planes[: self.primitive.graded - 3]
        shapes = shapes.to(finest(shapes.device))  # middles are subtracted from sums over pixels
        values = shapes.new_zeros((SUMS, shapes.shape[1])).requires_grad_()
        pairs = zip(residuals, self.grids, strict=True)
        asked = [moments(residual.to(values), grid.crop).permute(2, 0, 1) for residual, grid in pairs]
        with torch.enable_grad():
            images = [image[1:] for image in self._blended(torch.cat((shapes, values)))]
        (sums,) = torch.autograd.grad(images, values, asked)
        views, _, n = planes.shape
        sums = sums[:, : views * n].T.reshape(views, n, SUMS)
        return about(sums, planes[:, center : center + 2].transpose(1, 2).to(sums)).to(planes)

    def _pair_weights(self) -> Float[Tensor, "q"]:
        """For each pair the sum of the Gaussian's weight alpha T over the tile's pixels: the gradient of the
        picture's sum by a colour that each pair has for itself."""
        shapes = self.planes[: self.primitive.graded - 3].index_select(1, self.column)
        values = shapes.new_zeros((1, len(self.column))).requires_grad_()
        pairs = replace(self, column=torch.arange(len(self.column), device=self.column.device))
        with torch.enable_grad():
            shown = sum(image[1].sum() for image in pairs._blended(torch.cat((shapes, values))))
        return torch.autograd.grad(shown, values)[0][0]

    def _walked(
        self, rows: Float[Tensor, "d n"], images: Sequence[Float[Tensor, "c _h _w"]], step: Step
    ) -> list[Float[Tensor, "c _h _w"]]:
        """The states of all pixels behind their lists, from those in front; outside of crops they are -1."""
        state = self._tiled(images) + rows[:, :0].sum()  # in the graph, even if nothing is drawn
        centers = self._tiled([_centers(grid.crop, rows) for grid in self.grids])
        counts = torch.bincount(self.tile, minlength=state.shape[1])
        longest_first = counts.argsort(descending=True, stable=True)
        place = longest_first.argsort()
        number = torch.arange(len(self.tile), device=counts.device) - (counts.cumsum(0) - counts)[self.tile]
        # All firsts, all seconds and so on, with the tiles of the longest lists first in each.
        columns = self.column[(number * len(counts) + place[self.tile]).argsort()]
        few = torch.bincount(number).tolist()
        if rows.requires_grad and torch.is_grad_enabled():
            step = partial(checkpoint, step, use_reentrant=False)
        state, centers, ended = state[:, longest_first], centers[:, longest_first], []
        for splats in rows.index_select(1, columns)[..., None].split(few, dim=1):
            tiles = splats.shape[1]
            ended.append(state[:, tiles:])
            state = step(state[:, :tiles], splats, centers[:, :tiles], self.primitive)
        state = torch.cat((state, *reversed(ended)), dim=1)[:, place]
        parts = state.split([grid.tiles for grid in self.grids], dim=1)
        return [grid.to_image(part) for grid, part in zip(self.grids, parts, strict=True)]

    def _tiled(self, images: Sequence[Float[Tensor, "c _h _w"]]) -> Float[Tensor, "c t p"]:
        pairs = zip(self.grids, images, strict=True)
        return torch.cat([grid.to_tiles(image, fill=-1.0) for grid, image in pairs], dim=1)


def find_lists(
    parts: Sequence[Part], crops: Sequence[Crop], primitive: Primitive, windows: Windows, side: int
) -> Lists:
    """Every pair that may hold a fragment: the tile is in gsplat's rectangle of 16 px tiles around the middle
    and, of splats, reaches into the box around the ellipse of alpha = 1/255. See native.Lists."""
    planes = torch.cat([part.planes.detach() for part in parts], dim=1)
    counts = torch.tensor([part.planes.shape[1] for part in parts])
    picture = torch.tensor([part.picture for part in parts]).repeat_interleave(counts).to(planes.device)
    grids = tuple(TileGrid(crop, side) for crop in crops)
    bounds, opacity, radius = planes[[X, Y]], planes[-8], planes[-1]
    low = ((bounds - radius) / GSPLAT_TILE).floor() * GSPLAT_TILE
    high = ((bounds + radius) / GSPLAT_TILE).ceil() * GSPLAT_TILE - 1
    if primitive.name == "3dgs":
        reach = 2.0 * (opacity / MIN_ALPHA).log().clamp_min(0) + REACH_MARGIN
        half = (reach * planes[[kernels.COV_XX, kernels.COV_YY]]).sqrt()
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
    pairs = zip(_first_tiles(grids), grids, strict=True)
    numbers = [(first_tile - g.first_row * g.cols - g.first_col, g.cols) for first_tile, g in pairs]
    base, width = torch.tensor(numbers, device=owner.device).T[:, picture[rows]]
    line = first[1][owner] + torch.div(within, cols[owner], rounding_mode="floor")
    tile = base[owner] + width[owner] * line + first[0][owner] + within % cols[owner]
    tile, order = tile.sort(stable=True)
    lists = Lists(primitive, grids, planes, tile, rows[owner[order]])
    masked = torch.tensor([part.masked for part in parts]).repeat_interleave(counts).to(planes.device)
    return lists.within(windows, masked) if any(windows) else lists


def _first_tiles(grids: Sequence[TileGrid]) -> list[int]:
    """The number of each grid's first tile."""
    return [sum(grid.tiles for grid in grids[:k]) for k in range(len(grids))]


def _centers(crop: Crop, like: Tensor) -> Float[Tensor, "2 h w"]:
    """(x, y) of the pixels' centres in the full image."""
    x = torch.arange(crop.width, dtype=like.dtype, device=like.device) + (crop.x + 0.5)
    y = torch.arange(crop.height, dtype=like.dtype, device=like.device) + (crop.y + 0.5)
    return torch.stack((x.expand(crop.height, -1), y[:, None].expand(-1, crop.width)))


def _alphas(
    splats: Float[Tensor, "d t 1"], centers: Float[Tensor, "2 t p"], primitive: Primitive
) -> Float[Tensor, "t p"]:
    """min(0.999, opacity exp(-sigma)) of each fragment, 0 where it is not drawn."""
    dx, dy = splats[primitive.center : primitive.center + 2] - centers
    if primitive.name == "3dgs":
        xx, xy, yy = splats[kernels.CONIC_XX : kernels.CONIC_YY + 1]
        sigma = dx * (0.5 * xx * dx + xy * dy) + 0.5 * yy * dy * dy
        drawn = sigma >= 0
    else:
        sigma, drawn = _surfel_sigma(splats, dx, dy)
    alphas = (splats[primitive.graded - 4] * torch.exp(-sigma)).clamp_max(MAX_ALPHA)
    return torch.where(drawn & (alphas >= MIN_ALPHA), alphas, 0.0)


def _surfel_sigma(rows: Tensor, dx: Tensor, dy: Tensor) -> tuple[Tensor, Tensor]:
    """Where a pixel's ray meets the disc, or gsplat's low-pass filter around its box's middle. As in gsplat,
    rays within the disc's plane meet nothing."""
    u, v, a, b, c, d, e, f = rows.unbind(0)[kernels.U : kernels.F + 1]
    a, b, c, d = a - u * e, b - u * f, c - v * e, d - v * f  # pixels are counted from the disc's middle
    w = (a * d - b * c) - dx * (f * c - e * d) - dy * (e * b - f * a)
    meets = w != 0
    inverse = 1.0 / torch.where(meets, w, 1.0)
    s, t = (b * dy - d * dx) * inverse, (c * dx - a * dy) * inverse
    box_x, box_y = dx + (rows[X] - rows[kernels.U]), dy + (rows[Y] - rows[kernels.V])
    on_disc, filtered = 0.5 * (s * s + t * t), box_x * box_x + box_y * box_y
    is_disc = on_disc <= filtered
    # What is divided by next to nothing may be infinite where the filter counts.
    return torch.where(is_disc, torch.where(is_disc, on_disc, 0.0), filtered), meets


def _blend(state: Tensor, splats: Tensor, centers: Tensor, primitive: Primitive) -> Tensor:
    """A Step of transmittance, negative where nothing more is drawn, and of sums of weight x value."""
    left, *sums = state
    alphas = _alphas(splats, centers, primitive)
    next_left = left * (1.0 - alphas)
    drawn = next_left > MIN_TRANSMITTANCE
    weight = torch.where(drawn, alphas * left, 0.0)
    values = splats[primitive.graded - 3 :]
    sums = [so_far + weight * value for so_far, value in zip(sums, values, strict=True)]
    return torch.stack((torch.where(drawn, next_left, -left.abs()), *sums))


def _deepened(state: Tensor, splats: Tensor, centers: Tensor, primitive: Primitive) -> Tensor:
    """A Step of transmittance, negative where it is a half or less, and of the depth of the last fragment
    that is drawn while it is more."""
    left, depth = state
    alphas, passes = _alphas(splats, centers, primitive), left > 0.5
    depth = torch.where(passes & (alphas > 0), splats[DEPTH], depth)
    left = torch.where(passes, left * (1.0 - alphas), left)
    return torch.stack((torch.where(left > 0.5, left, -left.abs()), depth))
