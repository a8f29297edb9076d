"""A land of square tiles without end: any part of it can be made by itself, and photos cost no memory.

It is flat, so that a photo is the land's colour where each pixel's ray meets it; tiles are equal, so that a
scene of more tiles is larger and nothing else.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.gaussians.spherical_harmonics import SH_C0
from abcd_ns.engine.render.tile_grid import TileGrid
from abcd_ns.engine.space.intervals import ray_directions
from abcd_ns.engine.space.partition import build_kd
from abcd_ns.engine.space.tree import BlockTree
from abcd_ns.engine.types import Crop, Gaussians, View

HEIGHT = 1.1
"""Of the cameras over the land, in sides of a tile."""
SHIFT = 0.25
"""How far to either side of its tile's middle a camera stands."""
WAVES = ((3.1, 1.7, 0.2), (-2.3, 4.1, 1.1), (7.9, -5.3, 2.0), (11.3, 13.7, 0.7))
"""Frequencies along x and y, and phase, of the colours."""


@dataclass(frozen=True)
class Land:
    """`tiles` of them, a power of 2, in rows as long as possible up to a square."""

    tiles: int
    gaussians: int
    """In each tile."""
    views: int = 4
    """Cameras over each tile."""
    width: int = 160
    height: int = 120
    seed: int = 0

    def __post_init__(self) -> None:
        if self.tiles < 1 or self.tiles & (self.tiles - 1):
            raise ValueError(f"{self.tiles} tiles do not part in equal halves: give a power of 2")

    @property
    def columns(self) -> int:
        """Tiles in a row."""
        return 1 << math.ceil(math.log2(self.tiles) / 2)

    def corner(self, tile: int) -> tuple[int, int]:
        """(x, y) of a tile's lower corner."""
        return tile % self.columns, tile // self.columns

    def tree(self) -> BlockTree:
        """Cells of which each is one tile."""
        corners = torch.tensor([self.corner(tile) for tile in range(self.tiles)], dtype=torch.float64)
        middles = torch.cat([corners + 0.5, torch.zeros(self.tiles, 1, dtype=torch.float64)], dim=1)
        return build_kd(middles, self.tiles)

    def tile_of(self, tree: BlockTree) -> list[int]:
        """By block of `tree`, the tile in its cell."""
        middles = torch.tensor([[x + 0.5, y + 0.5, 0.0] for x, y in map(self.corner, range(self.tiles))])
        blocks = tree.assign(middles).tolist()
        return sorted(range(self.tiles), key=blocks.__getitem__)

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
        focal = 0.9 * self.width
        K = torch.tensor([[focal, 0, self.width / 2], [0, focal, self.height / 2], [0, 0, 1.0]])
        found = []
        for tile in range(self.tiles):
            x, y = self.corner(tile)
            for k in range(self.views):
                angle = 2 * math.pi * (k + 0.5) / self.views
                eye = (x + 0.5 + SHIFT * math.cos(angle), y + 0.5 + SHIFT * math.sin(angle), HEIGHT)
                found.append(
                    View(_looking_down(eye, angle), K, self.width, self.height, len(found), near=0.2)
                )
        return found

    def photo(self, view: View, crop: Crop) -> Float[Tensor, "h w 3"]:
        """What `view` sees; black beyond the land's border."""
        direction = ray_directions(view, TileGrid(crop, 1)).view(3, crop.height, crop.width)
        center = view.center
        depth = -center[2] / direction[2]
        x, y = center[0] + depth * direction[0], center[1] + depth * direction[1]
        rows = self.tiles // self.columns
        inside = (x >= 0) & (x < self.columns) & (y >= 0) & (y < rows) & (depth > 0)
        return torch.where(inside[..., None], color_of(x, y), 0.0)


def color_of(x: Float[Tensor, "*s"], y: Float[Tensor, "*s"]) -> Float[Tensor, "*s 3"]:
    """The land's colour at a place, 0..1."""
    channels = []
    for channel in range(3):
        waves = (torch.sin(a * x + b * y + phase + 2.1 * channel) for a, b, phase in WAVES)
        channels.append(0.5 + 0.45 * sum(waves) / len(WAVES))
    return torch.stack(channels, dim=-1)


def _looking_down(eye: tuple[float, float, float], angle: float) -> Float[Tensor, "4 4"]:
    """World to camera: z down and a little away from `angle`."""
    across = torch.tensor([-0.25 * math.cos(angle), -0.25 * math.sin(angle), -1.0])
    z = across / across.norm()
    right = torch.linalg.cross(z, torch.tensor([-math.cos(angle), -math.sin(angle), 0.0]))
    x = right / right.norm()
    rotation = torch.stack([x, torch.linalg.cross(z, x), z])
    matrix = torch.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = -rotation @ torch.tensor(eye)
    return matrix
