"""A land of square tiles without end: any part of it can be made by itself, and photos cost no memory.

It is flat, so that a photo is the land's colour where each pixel's ray meets it; tiles are equal, so that a
scene of more tiles is larger and nothing else.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.gaussians.spherical_harmonics import SH_C0
from abcd_ns.engine.space.partition import build_kd
from abcd_ns.engine.space.tree import BlockTree
from abcd_ns.engine.types import Crop, Gaussians, View
from abcd_ns.lab.world.world import Seen, World, camera

HEIGHT = 1.1  # of the cameras over the land, in sides of a tile
VIEWS = 4  # cameras over each tile
SIZE = (160, 120)  # of their pictures, pixels
SHIFT = 0.25  # how far to either side of its tile's middle a camera stands
WAVES = ((3.1, 1.7, 0.2), (-2.3, 4.1, 1.1), (7.9, -5.3, 2.0), (11.3, 13.7, 0.7))
"""Frequencies along x and y, and phase, of the colours."""


@dataclass(frozen=True)
class Land(World):
    """`tiles` of them, a power of 2, in rows as long as possible up to a square."""

    tiles: int
    gaussians: int  # in each tile
    seed: int = 0

    @property
    def columns(self) -> int:
        return 1 << math.ceil(math.log2(self.tiles) / 2)

    def corner(self, tile: int) -> tuple[int, int]:
        """(x, y) of a tile's lower corner."""
        return tile % self.columns, tile // self.columns

    @property
    def middles(self) -> Float[Tensor, "tiles 3"]:
        corners = torch.tensor([self.corner(tile) for tile in range(self.tiles)], dtype=torch.float64)
        return torch.cat([corners + 0.5, torch.zeros(self.tiles, 1, dtype=torch.float64)], dim=1)

    def tree(self) -> BlockTree:
        """Cells of which each is one tile."""
        return build_kd(self.middles, self.tiles)

    def make_tile(self, tile: int) -> Gaussians:
        """The Gaussians that training begins with: on the land, too grey, rather too large."""
        generator = torch.Generator().manual_seed(self.seed * 1_000_003 + tile)
        place = torch.rand((self.gaussians, 2), generator=generator)
        corner = torch.tensor(self.corner(tile), dtype=torch.float32)
        # Within the tile for certain, whatever is rounded.
        means = torch.cat([corner + 1e-4 + (1 - 2e-4) * place, torch.zeros(self.gaussians, 1)], dim=1)
        side = 1.0 / math.sqrt(self.gaussians)
        scales = torch.tensor([side, side, 0.1 * side]).log().expand(self.gaussians, 3).clone()
        grey = 0.5 * (color_of(means[:, 0], means[:, 1]) - 0.5)
        return Gaussians(
            means=means,
            scales=scales,
            quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(self.gaussians, 1),
            features_dc=grey / SH_C0,
            features_rest=torch.zeros(self.gaussians, 15, 3),
            opacities=torch.full((self.gaussians, 1), 1.0),
        )

    def cameras(self) -> list[View]:
        """All cameras, tile by tile, looking down and a little across the tile's middle."""
        found = []
        for tile in range(self.tiles):
            x, y = self.corner(tile)
            for k in range(VIEWS):
                angle = 2 * math.pi * (k + 0.5) / VIEWS
                across = math.cos(angle), math.sin(angle)
                eye = (x + 0.5 + SHIFT * across[0], y + 0.5 + SHIFT * across[1], HEIGHT)
                target = (x + 0.5 - 0.1 * SHIFT * across[0], y + 0.5 - 0.1 * SHIFT * across[1], 0.0)
                found.append(replace(camera(eye, target, len(found), SIZE), near=0.2))
        return found

    def crop(self, view: View, crop: Crop) -> Float[Tensor, "h w 3"]:
        """What `view` sees in a part of its picture."""
        return self.first(view, crop).colors.view(crop.height, crop.width, 3)

    def look(self, origin: Float[Tensor, "3"], directions: Float[Tensor, "n 3"]) -> Seen:
        """As World.look; black beyond the land's border."""
        t = -origin[2] / directions[:, 2]
        places = origin + t[:, None] * directions
        sides = places.new_tensor([self.columns, self.tiles // self.columns])
        hit = (t > 0) & ((places[:, :2] >= 0) & (places[:, :2] < sides)).all(dim=1)
        colors = color_of(*places.float().T[:2])
        return Seen(places, hit, torch.where(hit[:, None], colors, 0.0))


def color_of(x: Float[Tensor, "*s"], y: Float[Tensor, "*s"]) -> Float[Tensor, "*s 3"]:
    """The land's colour at a place, 0..1."""
    channels = []
    for channel in range(3):
        waves = (torch.sin(a * x + b * y + phase + 2.1 * channel) for a, b, phase in WAVES)
        channels.append(0.5 + 0.45 * sum(waves) / len(WAVES))
    return torch.stack(channels, dim=-1)
