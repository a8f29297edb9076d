"""Where the courts lie, what each holds, and the ground around them."""

import zlib
from dataclasses import dataclass
from typing import Literal

import numpy as np

from abcd_ns.lab.synth.geometry import Soup, patch
from abcd_ns.lab.synth.props import CENTREPIECES, FURNITURE, Workshop, banner, shelter, tower
from abcd_ns.lab.synth.textures import Color, Material, MaterialTable
from abcd_ns.lab.synth.walls import CELL, INNER, Opening, WallFinish, wall

Layout = Literal["grid", "row"]
_SIDES = ((0, 1), (-1, 0), (0, -1), (1, 0))
"""Towards the neighbour, per wall: north, west, south, east; wall k is turned by k quarter turns."""

_STYLES: tuple[tuple[Color, Color, Color, tuple[float, float]], ...] = (
    # base, second (mortar), third, block size: sandstone, red brick, grey stone, lime-washed, slate
    ((0.52, 0.42, 0.27), (0.34, 0.29, 0.21), (0.60, 0.50, 0.34), (0.90, 0.45)),
    ((0.42, 0.17, 0.11), (0.46, 0.42, 0.36), (0.52, 0.26, 0.16), (0.70, 0.35)),
    ((0.36, 0.37, 0.37), (0.22, 0.22, 0.21), (0.48, 0.47, 0.44), (1.00, 0.50)),
    ((0.62, 0.56, 0.44), (0.40, 0.36, 0.29), (0.55, 0.46, 0.32), (0.80, 0.40)),
    ((0.24, 0.29, 0.34), (0.36, 0.36, 0.35), (0.34, 0.38, 0.41), (0.80, 0.36)),
)
_ACCENTS: tuple[Color, ...] = (
    (0.48, 0.05, 0.05), (0.05, 0.13, 0.42), (0.55, 0.36, 0.04), (0.05, 0.27, 0.12), (0.30, 0.06, 0.30),
)  # fmt: skip
_FLAGS: tuple[tuple[Color, Color], ...] = (
    ((0.40, 0.37, 0.31), (0.50, 0.46, 0.38)),
    ((0.33, 0.33, 0.33), (0.44, 0.43, 0.41)),
    ((0.42, 0.31, 0.23), (0.50, 0.40, 0.31)),
)


@dataclass(frozen=True)
class Site:
    """The plan: which cells of a lattice hold courts."""

    cells: tuple[tuple[int, int], ...]
    """(column, row) of each court."""
    seed: int

    @staticmethod
    def plan(courts: int, layout: Layout, seed: int) -> "Site":
        """`courts` cells in one row, or filled row by row in the smallest near-square grid."""
        columns = courts if layout == "row" else int(np.ceil(np.sqrt(courts)))
        return Site(tuple((i % columns, i // columns) for i in range(courts)), seed)

    @property
    def _middle(self) -> np.ndarray:
        cells = np.array(self.cells, np.float64)
        return (cells.min(axis=0) + cells.max(axis=0)) / 2

    def center(self, court: int) -> np.ndarray:
        """The middle of a court's ground [3], metres; the site's middle is the origin."""
        return np.append((np.array(self.cells[court]) - self._middle) * CELL, 0.0)

    @property
    def half_diagonal(self) -> float:
        """From the origin to the farthest corner of the lattice's bounding box, metres."""
        spread = np.ptp(np.array(self.cells), axis=0) + 1
        return float(np.linalg.norm(spread) * CELL / 2)

    def neighbors(self, court: int) -> list[int]:
        """The courts whose cells touch this one's, corners included."""
        here = np.array(self.cells[court])
        return [i for i, c in enumerate(self.cells) if np.abs(here - c).max() == 1]

    def shares_wall(self, court: int, side: int) -> bool:
        """Is there a court beyond wall `side` (0..3: north, west, south, east)?"""
        return self._beyond(court, side) in self.cells

    def _beyond(self, court: int, side: int) -> tuple[int, int]:
        column, row = self.cells[court]
        return column + _SIDES[side][0], row + _SIDES[side][1]

    def rng(self, *key: object) -> np.random.Generator:
        """A random stream of its own for each key; independent of the order of use."""
        return np.random.default_rng([self.seed, zlib.crc32(repr(key).encode())])

    def openings(self, court: int, side: int) -> list[Opening]:
        """The openings of a court's wall, in that wall's own direction; equal from both of its sides."""
        lower, upper = sorted((self.cells[court], self._beyond(court, side)))
        rng = self.rng("edge", lower, upper)
        draw = _shared_openings if self.shares_wall(court, side) else _outer_openings
        found = draw(rng)
        # North and west walls run along +x and +y after their turn, south and east walls against them.
        return found if side < 2 else [o.mirrored() for o in found]


def _window(rng: np.random.Generator, center: float) -> Opening:
    return Opening(center, rng.uniform(0.9, 1.15), rng.uniform(0.95, 1.1), rng.uniform(1.75, 1.95))


def _gate(rng: np.random.Generator, center: float, width: float) -> Opening:
    return Opening(center, width, 0.0, rng.uniform(1.55, 1.75))


def _shared_openings(rng: np.random.Generator) -> list[Opening]:
    """A wide gate and a window on each side of it: much of the neighbour can be seen."""
    gate = _gate(rng, rng.uniform(-0.6, 0.6), rng.uniform(2.2, 2.6))
    return [_window(rng, -3.2), gate, _window(rng, 3.2)]


def _outer_openings(rng: np.random.Generator) -> list[Opening]:
    """A small gate or none, and one or two windows."""
    sides = [-3.1, 3.1] if rng.random() < 0.4 else [float(rng.choice([-3.1, 3.1]))]
    found = [_window(rng, s) for s in sides]
    if rng.random() < 0.45:
        found.append(_gate(rng, rng.uniform(-0.4, 0.4), rng.uniform(1.7, 2.0)))
    return found


def build_court(site: Site, court: int, table: MaterialTable) -> Soup:
    """Everything that stands in one court, in world coordinates; adds its materials to `table`."""
    rng = site.rng("court", court)
    style = int(rng.integers(len(_STYLES)) + court) % len(_STYLES)
    shop = Workshop(table, rng, _ACCENTS[(court * 2 + style) % len(_ACCENTS)])
    base, mortar, third, size = _STYLES[style]
    light = tuple(min(0.7, 0.35 + 0.5 * c) for c in base)
    trim = shop.material("clouds", light, mortar, tuple(0.85 * c for c in light))
    walls = [WallFinish(shop.material("blocks", base, mortar, third, size), trim) for _ in _SIDES]
    height = float(rng.uniform(3.1, 3.7))
    parts = [_floor(shop)]
    for side, finish in enumerate(walls):
        turn = side * np.pi / 2
        parts.append(wall(site.openings(court, side), height, finish).placed(yaw=turn))
        parts += [extra.placed(yaw=turn) for extra in _wall_extras(site, court, side, shop, height)]
    parts += _corners(shop, walls[0], height)
    parts += _middle(shop, int(court + site.seed))
    return Soup.cat(parts).placed(site.center(court))


def _floor(shop: Workshop) -> Soup:
    flag, pale = _FLAGS[shop.rng.integers(len(_FLAGS))]
    side = float(shop.rng.uniform(0.9, 1.2))
    ground = shop.material("paving", flag, (0.16, 0.15, 0.10), pale, (side, 0.8 * side))
    h = CELL / 2
    quad = np.array([[-h, -h, 0], [h, -h, 0], [h, h, 0], [-h, h, 0]])
    return patch(quad, np.array([0, 0, 1.0]), ground, 0.6)


def _wall_extras(site: Site, court: int, side: int, shop: Workshop, height: float) -> list[Soup]:
    """Banners on both sides of a gate, or a shelter where the wall has no gate."""
    gates = [o for o in site.openings(court, side) if o.sill == 0]
    if gates:
        hung = [gates[0].center - gates[0].width / 2 - 0.85, gates[0].center + gates[0].width / 2 + 0.85]
        free = [s for s in hung if all(abs(s - o.center) > 1.0 for o in site.openings(court, side))]
        return [banner(shop, height - 0.25).placed((s, INNER - 0.07, 0)) for s in free]
    lean_to = shelter(shop, 2.8).placed((0.0, INNER, 0))
    stores = [FURNITURE[k](shop).placed((s, INNER - 0.55, 0)) for s, k in ((-0.75, 0), (0.1, 0), (0.95, 1))]
    return [lean_to, *stores]


def _corners(shop: Workshop, finish: WallFinish, height: float) -> list[Soup]:
    """Turrets, or furniture, in the four corners."""
    at = INNER - 0.75
    parts = []
    roofed = int(shop.rng.integers(4))
    for k in range(4):
        place, turn = (at, at, 0.0), k * np.pi / 2
        if (k - roofed) % 4 < 2:
            thing = tower(shop, finish.wall, finish.trim, height + 0.9, roofed=k == roofed)
        else:
            pair = shop.rng.choice(len(FURNITURE), 2, replace=False)
            thing = Soup.cat([
                FURNITURE[pair[0]](shop).placed((0.1, 0.1, 0), shop.rng.uniform(-0.4, 0.4)),
                FURNITURE[pair[1]](shop).placed((-1.05, 0.2, 0), shop.rng.uniform(-0.2, 0.2)),
            ])  # fmt: skip
        parts.append(thing.placed(place).placed(yaw=turn))
    return parts


def _middle(shop: Workshop, turn: int) -> list[Soup]:
    """A centrepiece with furniture about it."""
    parts = [CENTREPIECES[turn % len(CENTREPIECES)](shop).placed(yaw=shop.rng.uniform(0, 1.5))]
    start = shop.rng.uniform(0, np.pi / 2)
    for k, which in enumerate(shop.rng.integers(2, len(FURNITURE), 4)):
        angle = start + k * np.pi / 2 + shop.rng.uniform(-0.2, 0.2)
        place = (2.35 * np.cos(angle), 2.35 * np.sin(angle), 0.0)
        parts.append(FURNITURE[which](shop).placed(place, angle + np.pi / 2))
    return parts


def build_field(table: MaterialTable, radius: float) -> Soup:
    """The meadow under and around all courts, a square that reaches past `radius` metres."""
    green = (0.15, 0.25, 0.06)
    h = 1.1 * radius
    quad = np.array([[-h, -h, -0.02], [h, -h, -0.02], [h, h, -0.02], [-h, h, -0.02]])
    grass = table.add(Material("meadow", green, green, green))
    return patch(quad, np.array([0, 0, 1.0]), grass, max_edge=2 * h)
