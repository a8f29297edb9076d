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

    def origins(
        self, tiles: Int[Tensor, "a"], dtype: torch.dtype
    ) -> tuple[Float[Tensor, "a"], Float[Tensor, "a"]]:
        """(x, y) of the tiles' upper left corners, in pixels of the full image."""
        x = (self.first_col + tiles % self.cols) * self.side
        y = (self.first_row + tiles // self.cols) * self.side
        return x.to(dtype), y.to(dtype)

    def to_tiles(self, image: Float[Tensor, "c h w"], fill: float = 0.0) -> Float[Tensor, "c p t"]:
        """[channel, pixel in tile, tile] from an image of the crop; `fill` where tiles stick out of it."""
        left, top = self.crop.x - self.first_col * self.side, self.crop.y - self.first_row * self.side
        right = self.cols * self.side - left - self.crop.width
        bottom = self.rows * self.side - top - self.crop.height
        padded = F.pad(image, (left, right, top, bottom), value=fill)
        tiled = padded.view(-1, self.rows, self.side, self.cols, self.side).permute(0, 2, 4, 1, 3)
        return tiled.reshape(image.shape[0], self.pixels_per_tile, self.rows * self.cols)

    def to_image(self, tiled: Float[Tensor, "c p t"]) -> Float[Tensor, "c h w"]:
        """The inverse of `to_tiles`."""
        blocks = tiled.view(-1, self.side, self.side, self.rows, self.cols).permute(0, 3, 1, 4, 2)
        padded = blocks.reshape(tiled.shape[0], self.rows * self.side, self.cols * self.side)
        top, left = self.crop.y - self.first_row * self.side, self.crop.x - self.first_col * self.side
        return padded[:, top : top + self.crop.height, left : left + self.crop.width]
