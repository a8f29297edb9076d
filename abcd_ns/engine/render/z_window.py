"""Pixels as small square tiles, and which fragments count in each: a range of camera z (fragment ownership).

A fragment is one Gaussian at one pixel; its z is the camera z of the Gaussian's mean. Rasterizers sort
Gaussians by tile, and within a tile by z, so a window for each tile is a filter of that list and needs no
kernel of its own. Windows that tile z in each tile part its list into runs: drawn each by itself and folded,
they give the whole picture, whatever the side of the tiles.
"""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from abcd_ns.engine.transfer import finest
from abcd_ns.engine.types import Crop


@dataclass(frozen=True)
class TileGrid:
    """The tiles of `side` x `side` pixels that cover a crop.

    Tiles are aligned to the full image, not to the crop: a pixel has the same place in the same tile
    whatever the crop, so that it sees the same arithmetic. Tiles are numbered row by row from 0; pixels
    in a tile too.
    """

    crop: Crop
    side: int

    @property
    def first_col(self) -> int:
        """Column of the leftmost tiles, counted in tiles from the full image's edge."""
        return self.crop.x // self.side

    @property
    def first_row(self) -> int:
        return self.crop.y // self.side

    @property
    def cols(self) -> int:
        return -(-(self.crop.x + self.crop.width) // self.side) - self.first_col

    @property
    def rows(self) -> int:
        return -(-(self.crop.y + self.crop.height) // self.side) - self.first_row

    @property
    def tiles(self) -> int:
        return self.rows * self.cols

    def middles(
        self, dtype: torch.dtype, device: torch.device | str
    ) -> tuple[Float[Tensor, "c"], Float[Tensor, "r"]]:
        """(x of each column's, y of each row's) middle, in pixels of the full image.

        It does not depend on the crop, and may lie outside of it, or of the image, by up to half a tile.
        """
        numbers = ((self.first_col, self.cols), (self.first_row, self.rows))
        x, y = (torch.arange(first, first + n, dtype=dtype, device=device) for first, n in numbers)
        return x * self.side + self.side / 2, y * self.side + self.side / 2

    def pixels(self, device: torch.device | str) -> Int[Tensor, "t"]:
        """How many pixels of the crop each tile holds."""
        spans = (
            (self.first_col, self.cols, self.crop.x, self.crop.width),
            (self.first_row, self.rows, self.crop.y, self.crop.height),
        )
        counts = []
        for first, n, start, size in spans:
            low = torch.arange(first, first + n, device=device) * self.side
            counts.append((low + self.side).clamp_max(start + size) - low.clamp_min(start))
        return (counts[1][:, None] * counts[0]).flatten()

    def part(self, values: Shaped[Tensor, "*c t"], grid: "TileGrid") -> Shaped[Tensor, "*c _t"]:
        """What the tiles of a crop of this crop have of these values.

        Raises:
            ValueError: the grid's tiles are none of these.
        """
        if grid == self:
            return values
        x, y = grid.first_col - self.first_col, grid.first_row - self.first_row
        if grid.side != self.side or min(x, y) < 0 or x + grid.cols > self.cols or y + grid.rows > self.rows:
            raise ValueError(f"{self} has not all tiles of {grid}")
        tiles = values.unflatten(-1, (self.rows, self.cols))
        return tiles[..., y : y + grid.rows, x : x + grid.cols].flatten(-2)

    def to_tiles(self, image: Float[Tensor, "c h w"], fill: float = 0.0) -> Float[Tensor, "c t p"]:
        """[channel, tile, pixel in tile] from an image of the crop; `fill` where tiles stick out of it."""
        left, top = self.crop.x - self.first_col * self.side, self.crop.y - self.first_row * self.side
        right = self.cols * self.side - left - self.crop.width
        bottom = self.rows * self.side - top - self.crop.height
        padded = F.pad(image, (left, right, top, bottom), value=fill)
        tiled = padded.view(-1, self.rows, self.side, self.cols, self.side).transpose(2, 3)
        return tiled.reshape(len(image), self.tiles, self.side**2)

    def to_image(self, tiled: Float[Tensor, "c t p"]) -> Float[Tensor, "c h w"]:
        """The inverse of `to_tiles`."""
        blocks = tiled.reshape(-1, self.rows, self.cols, self.side, self.side).transpose(2, 3)
        padded = blocks.reshape(len(tiled), self.rows * self.side, self.cols * self.side)
        top, left = self.crop.y - self.first_row * self.side, self.crop.x - self.first_col * self.side
        return padded[:, top : top + self.crop.height, left : left + self.crop.width]


@dataclass(frozen=True)
class ZWindow:
    """In each tile of a crop, fragments are drawn where near <= z < far.

    An empty interval (near >= far) draws nothing. Infinities are allowed.
    """

    grid: TileGrid
    near: Float[Tensor, "t"]
    far: Float[Tensor, "t"]

    @staticmethod
    def everything(grid: TileGrid, device: torch.device | str, dtype: torch.dtype) -> "ZWindow":
        """All of z, everywhere."""
        infinity = torch.full((grid.tiles,), math.inf, device=device, dtype=dtype)
        return ZWindow(grid, -infinity, infinity)

    def cut_by(self, other: "ZWindow") -> tuple["ZWindow", "ZWindow", "ZWindow"]:
        """The part of this window in front of another one, that one, and the part behind it."""
        front = ZWindow(self.grid, self.near, torch.minimum(self.far, other.near))
        return front, other, ZWindow(self.grid, torch.maximum(self.near, other.far), self.far)

    def on(self, grid: TileGrid) -> "ZWindow":
        """The same window on the tiles of a crop of this crop, see TileGrid.part."""
        return ZWindow(grid, self.grid.part(self.near, grid), self.grid.part(self.far, grid))


def ends_of(window: ZWindow | None, grid: TileGrid, like: Tensor) -> Float[Tensor, "2 t"]:
    """(near, far) of a window in the tiles of a grid, see ZWindow.on. None, as `like`, masks nothing."""
    found = ZWindow.everything(grid, like.device, like.dtype) if window is None else window.on(grid)
    return torch.stack((found.near, found.far))


@torch.no_grad()
def showing(
    pixels: Int[Tensor, "c t"],
    tile: Int[Tensor, "q"],
    z: Float[Tensor, "q"],
    weight: Float[Tensor, "q"],
    visible: float,
) -> Float[Tensor, "2 c t"]:
    """The ranges of camera z, in each tile of c crops, in which a set of Gaussians shows: near and far of a
    visit's windows.

    Frozen fragments in front of this range and behind it can be drawn once for a visit; those in it have to
    be sorted in with the Gaussians that are trained. So the range must hold every fragment that matters, and
    the narrower it is, the less is drawn in each step.

    Args:
        pixels: of its crop in each tile; 0 for one that a crop does not have.
        tile, z, weight: of each pair of a Gaussian and a tile, which are numbered through from crop to crop,
            sorted by tile and then by z; the weight is the sum of alpha T over the tile's pixels.
        visible: what the fragments in front of the range, and those behind it, weigh less than, together and
            as a mean over the tile; 0 takes all.

    Returns:
        Windows that hold all else. Where there is nothing they are empty, and lie in the midst of what
        the crop shows.
    """
    crops, tiles = pixels.shape
    ends = torch.searchsorted(tile, torch.arange(crops * tiles, device=tile.device), right=True)
    share = weight.to(finest(weight.device)) / pixels.flatten().clamp_min(1).index_select(0, tile)
    # Sums of the first 0, 1, 2, ... pairs.
    so_far, mass = (F.pad(values.cumsum(0), (1, 0)) for values in (share, share * z))
    starts = torch.cat((ends.new_zeros(1), ends[:-1]))
    before, after = so_far[starts], so_far[ends]
    # With what is in front of each pair, and with what is behind it; rounding must not lose any at 0.
    head = so_far[1:] - before.index_select(0, tile)
    tail = after.index_select(0, tile) - so_far[:-1]
    every = visible <= 0
    none = z.new_full(ends.shape, math.inf)
    near = none.scatter_reduce(0, tile, torch.where((head >= visible) | every, z, math.inf), "amin")
    far = (-none).scatter_reduce(0, tile, torch.where((tail >= visible) | every, z, -math.inf), "amax")
    held, of_z = ((sums[ends] - sums[starts]).view(crops, tiles) for sums in (so_far, mass))
    return window_between(near.view(crops, tiles), far.view(crops, tiles), held, of_z).to(z)


def window_between(
    near: Float[Tensor, "c t"],
    far: Float[Tensor, "c t"],
    held: Float[Tensor, "c t"],
    of_z: Float[Tensor, "c t"],
) -> Float[Tensor, "2 c t"]:
    """What `showing` returns, from the least and the largest z that count in each tile, infinite where none
    does, and from the sums of weights and of weights times z."""
    first, last, empty = torch.minimum(near, far), torch.maximum(near, far), near.isinf()
    # Half open: the next number after the last depth.
    last = torch.nextafter(last, torch.full_like(last, math.inf))
    midst = torch.where(held > 0, of_z / held, of_z.sum(1, keepdim=True) / held.sum(1, keepdim=True))
    return torch.where(empty, midst.nan_to_num(0.0).to(near), torch.stack((first, last)))
