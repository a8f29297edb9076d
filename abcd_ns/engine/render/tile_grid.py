"""Pixels as small square tiles: the layout in which the torch rasterizer computes."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

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
    def pixels_per_tile(self) -> int:
        return self.side * self.side

    @property
    def tiles(self) -> int:
        """How many there are."""
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

    def to_tiles(self, image: Float[Tensor, "c h w"], fill: float = 0.0) -> Float[Tensor, "c t p"]:
        """[channel, tile, pixel in tile] from an image of the crop; `fill` where tiles stick out of it."""
        left, top = self.crop.x - self.first_col * self.side, self.crop.y - self.first_row * self.side
        right = self.cols * self.side - left - self.crop.width
        bottom = self.rows * self.side - top - self.crop.height
        padded = F.pad(image, (left, right, top, bottom), value=fill)
        tiled = padded.view(-1, self.rows, self.side, self.cols, self.side).transpose(2, 3)
        return tiled.reshape(len(image), self.tiles, self.pixels_per_tile)

    def to_image(self, tiled: Float[Tensor, "c t p"]) -> Float[Tensor, "c h w"]:
        """The inverse of `to_tiles`."""
        blocks = tiled.reshape(-1, self.rows, self.cols, self.side, self.side).transpose(2, 3)
        padded = blocks.reshape(len(tiled), self.rows * self.side, self.cols * self.side)
        top, left = self.crop.y - self.first_row * self.side, self.crop.x - self.first_col * self.side
        return padded[:, top : top + self.crop.height, left : left + self.crop.width]
