"""Worlds seen along exact rays, their cameras, and small ones of textured balls and walls."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from abcd_ns.engine.render.z_window import TileGrid
from abcd_ns.engine.space.intervals import ray_directions
from abcd_ns.engine.types import Crop, View

WAVES = 5  # sines that a texture is the sum of, for each colour
FAR = 1e9
RAYS_AT_ONCE = 1 << 17  # so many fit into a processor's cache


@dataclass(frozen=True)
class Ball:
    """A textured sphere; seen from inside it is a shell around everything."""

    center: tuple[float, float, float]
    radius: float
    fineness: float = 1.0  # how many times finer than usual its texture is

    def meet(self, origin: Tensor, directions: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """How far along each ray it is, in lengths of the direction; FAR where it is not."""
        middle = origin - torch.tensor(self.center, dtype=origin.dtype)
        a = directions.square().sum(dim=1)
        b = (directions * middle).sum(dim=1)
        c = middle.square().sum() - self.radius**2
        root = (b * b - a * c).clamp_min(0).sqrt()
        near, far = (-b - root) / a, (-b + root) / a
        t = torch.where(near > 1e-6, near, far)
        return torch.where((b * b - a * c > 0) & (t > 1e-6), t, FAR)


@dataclass(frozen=True)
class Wall:
    """A textured rectangle across one axis."""

    axis: int
    at: float
    half: float  # half its side; it lies around the origin of the other two axes
    fineness: float = 1.0

    def meet(self, origin: Tensor, directions: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        t = (self.at - origin[self.axis]) / directions[:, self.axis]
        place = origin + t[:, None] * directions
        others = [k for k in range(3) if k != self.axis]
        return torch.where((t > 1e-6) & (place[:, others].abs().amax(dim=1) <= self.half), t, FAR)


class Seen(NamedTuple):
    """What n rays see."""

    places: Float[Tensor, "n 3"]  # where they end, world; the origin of a ray that meets nothing
    hit: Bool[Tensor, "n"]  # whether anything near is there
    colors: Float[Tensor, "n 3"]  # 0..1


class World(ABC):
    """What looks the same from everywhere."""

    @abstractmethod
    def look(self, origin: Float[Tensor, "3"], directions: Float[Tensor, "n 3"]) -> Seen:
        """Along rays."""

    def first(self, view: View, crop: Crop | None = None) -> Seen:
        """Along each pixel's ray, row by row."""
        exact = view.to(torch.float64)
        directions = ray_directions(exact, TileGrid(crop or exact.full, 1)).T
        return self.look(view.center.double(), directions)

    def photo(self, view: View) -> Float[Tensor, "h w 3"]:
        """The picture: the mean of four rays in each pixel."""
        larger = view.resized(2.0, 2 * view.width, 2 * view.height)
        rows, bands = max(1, RAYS_AT_ONCE // (2 * larger.width)), []
        for top in range(0, view.height, rows):
            height = 2 * min(rows, view.height - top)
            band = self.first(larger, Crop(0, 2 * top, larger.width, height)).colors
            bands.append(F.avg_pool2d(band.reshape(height, larger.width, 3).permute(2, 0, 1), 2))
        return torch.cat(bands, dim=1).permute(1, 2, 0).float().contiguous()

    def points(self, views: list[View], count: int) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
        """About `count` points on what the views see, as a reconstruction would give, and colours 0..255."""
        generator = torch.Generator().manual_seed(0)
        places, colors = [], []
        for view in views:
            where, hit, color = self.first(view)
            rows = hit.nonzero()[:, 0]
            chosen = rows[torch.randperm(len(rows), generator=generator)[: -(-count // len(views))]]
            places.append(where[chosen])
            colors.append(color[chosen])
        return torch.cat(places), 255 * torch.cat(colors).float()


@dataclass(frozen=True)
class Surfaces(World):
    """Balls and walls with textures of random waves. What no ray meets is black."""

    surfaces: tuple[Ball | Wall, ...]
    seed: int = 0
    plain: float = 0.0
    """Share of the waves that is the same for all colours: with 1 a surface has shades of one colour."""

    def look(self, origin: Float[Tensor, "3"], directions: Float[Tensor, "n 3"]) -> Seen:
        t = torch.stack([surface.meet(origin, directions) for surface in self.surfaces])
        nearest, which = t.min(dim=0)
        hit = nearest < FAR / 2
        places = origin + torch.where(hit, nearest, 0.0)[:, None] * directions
        colors = torch.zeros_like(places)
        for number, surface in enumerate(self.surfaces):
            mine = hit & (which == number)
            colors[mine] = self._texture(number, surface, places[mine])
        return Seen(places, hit, colors)

    def _texture(self, number: int, surface: Ball | Wall, places: Float[Tensor, "n 3"]) -> Tensor:
        generator = torch.Generator().manual_seed(1000 * self.seed + number)
        draw = {"generator": generator, "dtype": torch.float64}
        turns = torch.randn((3, WAVES, 3), **draw)
        turns = turns / turns.norm(dim=-1, keepdim=True) * (4 + 14 * torch.rand((3, WAVES, 1), **draw))
        phase = 2 * math.pi * torch.rand((3, WAVES), **draw)
        base = 0.3 + 0.4 * torch.rand(3, **draw)
        if isinstance(surface, Ball) and surface.radius > 1:
            places = places / surface.radius  # a far shell is as finely textured, as it looks
        waves = torch.sin(surface.fineness * torch.einsum("nk,cwk->ncw", places, turns) + phase)
        waves = waves.sum(dim=-1)
        waves = waves.lerp(waves.mean(dim=1, keepdim=True), self.plain)
        return (base + 0.12 * waves).clamp(0.02, 0.98)


def look_at(eye: Tensor, target: Tensor) -> Float[Tensor, "4 4"]:
    """World to camera, OpenCV convention, with the world's z up."""
    forward = F.normalize(target - eye, dim=0)
    right = F.normalize(torch.linalg.cross(forward, forward.new_tensor([0.0, 0.0, 1.0])), dim=0)
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    viewmat = torch.eye(4, dtype=eye.dtype)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ eye
    return viewmat


def camera(
    eye: Sequence[float], target: Sequence[float], index: int, size: tuple[int, int], focal: float = 1.0
) -> View:
    """A camera at `eye` that looks at `target`; `focal` is its focal length in widths of the picture."""
    (width, height), f = size, focal * size[0]
    K = torch.tensor([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1]])
    pose = look_at(torch.tensor(eye, dtype=torch.float64), torch.tensor(target, dtype=torch.float64))
    return View(pose.float(), K, width, height, index)


def ring(count: int, *, turn: float = 0.0, size: tuple[int, int] = (48, 36)) -> list[View]:
    """Cameras on the unit circle, at three heights in turn, all looking at the middle. `turn` moves all by
    that share of the step from camera to camera."""
    views = []
    for index in range(count):
        angle = 2 * math.pi * (index + turn) / count
        eye = (math.cos(angle), math.sin(angle), 0.15 + 0.2 * (index % 3))
        views.append(camera(eye, (0.0, 0.0, 0.0), index, size))
    return views


TABLE = Surfaces(
    (
        Ball((0.0, 0.0, 0.02), 0.17),
        Ball((0.3, 0.1, -0.06), 0.11),
        Ball((-0.22, 0.26, -0.05), 0.12),
        Ball((-0.15, -0.3, -0.08), 0.1),
        Ball((0.2, -0.24, -0.04), 0.13),
        Wall(2, -0.18, 0.6),
        Ball((0.0, 0.0, 0.0), 4.0),
    )
)
"""Five balls on a table in a large round room; cameras stand at a distance of 1."""
