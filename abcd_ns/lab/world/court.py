"""The walled court of `abcd demo`: what stands in it, and the cameras that walk it."""

import math
import zlib
from dataclasses import replace

import numpy as np
import torch

from abcd_ns.engine.types import View
from abcd_ns.lab.world.solids import Solid, Thing, ball, block, tube, turned
from abcd_ns.lab.world.sunlight import SunlitWorld
from abcd_ns.lab.world.textures import Color, Material
from abcd_ns.lab.world.world import camera

CELL = 12.0
"""Side of the court, metres, from the middle of one wall to the middle of the next."""
INNER = CELL / 2 - 0.3
"""From the court's centre to the inner face of its walls, metres."""
DOME = 60.0
"""Radius of the sky about the origin, metres."""
HEIGHT = 3.4
"""Of the walls, without their battlements, metres."""
FOCAL = 0.72
"""Focal length over image width: a horizontal field of view of 70 degrees."""
TURN = 2 * np.pi * (np.sqrt(2) - 1)
"""From one camera to the next. Eight of them, from one held-out view to the next, go around evenly as well;
eight golden angles do not."""
HEIGHTS = (7.0, 10.5)
"""Metres over the ground: above all towers, so that no camera stands in anything, whatever the court."""

# base, second (mortar), third, block size: sandstone, red brick, grey stone, lime-washed, slate
STYLES: tuple[tuple[Color, Color, Color, tuple[float, float]], ...] = (
    ((0.52, 0.42, 0.27), (0.34, 0.29, 0.21), (0.60, 0.50, 0.34), (0.90, 0.45)),
    ((0.42, 0.17, 0.11), (0.46, 0.42, 0.36), (0.52, 0.26, 0.16), (0.70, 0.35)),
    ((0.36, 0.37, 0.37), (0.22, 0.22, 0.21), (0.48, 0.47, 0.44), (1.00, 0.50)),
    ((0.62, 0.56, 0.44), (0.40, 0.36, 0.29), (0.55, 0.46, 0.32), (0.80, 0.40)),
    ((0.24, 0.29, 0.34), (0.36, 0.36, 0.35), (0.34, 0.38, 0.41), (0.80, 0.36)),
)
DARK: Color = (0.07, 0.045, 0.03)
OAK = Material("blocks", (0.32, 0.19, 0.09), DARK, (0.45, 0.30, 0.16), (0.16, 2.0))
MARBLE = Material("clouds", (0.62, 0.60, 0.55), (0.36, 0.36, 0.35), (0.48, 0.44, 0.40))
TILES = Material("blocks", (0.38, 0.16, 0.09), DARK, (0.50, 0.25, 0.14), (0.28, 0.24))
WATER = Material("clouds", (0.05, 0.17, 0.20), (0.05, 0.17, 0.20), (0.13, 0.33, 0.36))
LEAVES = Material("clouds", (0.11, 0.20, 0.04), (0.02, 0.05, 0.015), (0.25, 0.34, 0.07), (0.4, 1.0))
GRASS = Material("clouds", (0.24, 0.27, 0.08), (0.12, 0.16, 0.04), (0.10, 0.22, 0.045), (3.0, 1.0))


def crates(rng: np.random.Generator) -> list[Solid]:
    """Two boxes, the smaller on top and turned."""
    a, b = rng.uniform(0.35, 0.45), rng.uniform(0.22, 0.3)
    top = block((-b, -b, 0), (b, b, 2 * b), OAK).placed((0.05, -0.04, 2 * a), rng.uniform(0.2, 0.7))
    return [block((-a, -a, 0), (a, a, 2 * a), OAK), top]


def bench(rng: np.random.Generator) -> list[Solid]:  # noqa: ARG001 - all are alike
    """A plank on two stones."""
    legs = [block((x - 0.1, -0.2, 0), (x + 0.1, 0.2, 0.42), MARBLE) for x in (-0.6, 0.6)]
    return [*legs, block((-0.9, -0.26, 0.42), (0.9, 0.26, 0.5), OAK)]


def bush(rng: np.random.Generator) -> list[Solid]:
    """Four clumps of leaves."""
    clump = replace(LEAVES, salt=float(rng.integers(60)))
    angles = 2 * np.pi * np.arange(3) / 3 + rng.uniform(0, 1, 3)
    sides = [ball((0.28 * np.cos(a), 0.28 * np.sin(a), 0.4), rng.uniform(0.27, 0.38), clump) for a in angles]
    return [ball((0, 0, 0.35), 0.45, clump), *sides]


def fountain() -> list[Solid]:
    """Two bowls with water about a stem, a ball on top."""
    bowl = replace(ball((0, 0, 1.42), 0.8, MARBLE, 0.4), holes=(block((-1, -1, 1.42), (1, 1, 2), MARBLE),))
    return [
        tube(1.5, 0, 0.6, MARBLE, tube(1.3, 0.2, 0.7, MARBLE)),
        tube(1.58, 0.52, 0.66, MARBLE, tube(1.3, 0.2, 0.7, MARBLE)),
        tube(1.31, 0.2, 0.48, WATER),
        tube(0.2, 0.4, 1.1, MARBLE),
        bowl,
        tube(0.8, 1.36, 1.46, MARBLE, tube(0.68, 1.3, 1.5, MARBLE)),
        tube(0.69, 1.3, 1.425, WATER),
        tube(0.11, 1.4, 1.85, MARBLE),
        ball((0, 0, 2.0), 0.2, TILES),
    ]


def tower(wall: Material, trim: Material, roofed: bool) -> list[Solid]:
    """A round turret of the walls' stone, with a tiled dome or a battlement."""
    top = HEIGHT + 0.9
    parts = [tube(0.85, 0, top, wall), tube(0.95, 0, 0.36, trim), tube(1.0, top, top + 0.2, trim)]
    if roofed:
        under = block((-1, -1, top - 1), (1, 1, top + 0.2), TILES)
        return [*parts, replace(ball((0, 0, top + 0.2), 0.97, TILES, 1.2), holes=(under,))]
    notches = [block((-1.1, -0.15, top + 0.3), (1.1, 0.15, top + 0.8), wall).placed(yaw=k * np.pi / 4)
               for k in range(4)]  # fmt: skip
    return [*parts, tube(0.97, top + 0.2, top + 0.65, wall, tube(0.62, top + 0.2, top + 1, wall), *notches)]


FURNITURE = (crates, bench, bush)


def gate(center: float, material: Material, grow: float = 0.0, deep: float = 0.5) -> list[Solid]:
    """What a gate with a round head leaves out of a wall along x, or a frame `grow` metres wider."""
    half = 1.1 + grow
    return [
        block((center - half, -deep, -0.01), (center + half, deep, 1.65), material),
        Solid("tube", (half, half, deep), material, (center, 0.0, 1.65), turned(tilt=np.pi / 2)),
    ]


def stream(seed: int, *key: object) -> np.random.Generator:
    """A random stream of its own for each key; independent of the order of use."""
    return np.random.default_rng([seed, zlib.crc32(repr(key).encode())])


def build_world(seed: int) -> SunlitWorld:
    """The court on a meadow, its middle at the origin."""
    h = 1.1 * DOME
    meadow = Thing((block((-h, -h, -1.02), (h, h, -0.02), GRASS),))
    return SunlitWorld([meadow, build_court(seed)], DOME, seed)


def build_court(seed: int) -> Thing:
    """Everything that stands in the court."""
    rng = stream(seed, "court", 0)
    style = int(rng.integers(len(STYLES)))
    base, mortar, third, size = STYLES[style]
    light = tuple(min(0.7, 0.35 + 0.5 * c) for c in base)
    wall = Material("blocks", base, mortar, third, size, float(rng.integers(60)))
    trim = Material("clouds", light, mortar, tuple(0.85 * c for c in light))
    flags = Material(
        "blocks", (0.38, 0.35, 0.30), (0.16, 0.15, 0.10), (0.48, 0.44, 0.38), (1.1, 0.9), wall.salt
    )
    h = CELL / 2
    things = [Thing((block((-h, -h, -1.0), (h, h, 0.0), flags),))]
    for side in range(4):
        parts = _wall(_gate_of(seed, side), wall, trim)
        things.append(Thing(tuple(parts)).placed(yaw=side * np.pi / 2))
    for k, turn in enumerate(np.arange(4) * np.pi / 2):
        place, make = (INNER - 0.75, INNER - 0.75, 0.0), FURNITURE[rng.integers(len(FURNITURE))]
        corner = tower(wall, trim, roofed=k == 0) if k < 2 else make(rng)
        things.append(Thing(tuple(corner)).placed(place).placed(yaw=turn + wall.salt * np.pi / 2))
    things.append(Thing(tuple(fountain())))
    start = rng.uniform(0, np.pi / 2)
    for k, which in enumerate(rng.integers(len(FURNITURE), size=4)):
        angle = start + k * np.pi / 2 + rng.uniform(-0.2, 0.2)
        at = (2.5 * np.cos(angle), 2.5 * np.sin(angle), 0.0)
        things.append(Thing(tuple(FURNITURE[which](rng))).placed(at, angle + np.pi / 2))
    return Thing(tuple(things))


def _gate_of(seed: int, side: int) -> float | None:
    """Where a wall has a gate, metres from its middle; half of them have one."""
    rng = stream(seed, "edge", (0, 0), side)
    center = rng.uniform(-0.6, 0.6)
    return center if rng.random() < 0.5 else None


def _wall(center: float | None, wall: Material, trim: Material) -> list[Solid]:
    """The northern wall: plinth, gate with a frame, cornice, battlements."""
    h, middle, pitch = CELL / 2, (0, CELL / 2, 0), CELL / 10
    low, high = (-h, INNER), (h, CELL - INNER)

    def gate_of(*size: float) -> list[Solid]:
        return [] if center is None else [part.placed(middle) for part in gate(center, trim, *size)]

    notches = [
        block((x, -1, HEIGHT), (x + 0.42 * pitch, 1, HEIGHT + 1), wall).placed(middle)
        for x in pitch * np.arange(-5, 5)
    ]
    return [
        block((*low, 0), (*high, HEIGHT), wall, *gate_of()),
        block((*low, HEIGHT), (*high, HEIGHT + 0.55), wall, *notches),
        block((-h, INNER - 0.08, 0), (h, CELL - INNER + 0.08, 0.32), trim, *gate_of()),
        block((-h, INNER - 0.07, HEIGHT - 0.16), (h, CELL - INNER + 0.07, HEIGHT + 0.01), trim),
        *(replace(frame, holes=tuple(gate_of())) for frame in gate_of(0.18, 0.36)),
    ]


def court_cameras(seed: int, count: int, size: tuple[int, int]) -> list[View]:
    """`count` cameras (float64) on a rising spiral above the court's walls, all looking into it.

    Any part of the list looks from all around, and what a held-out view shows is in its neighbours' views.
    """
    rng = stream(seed, "cameras", 0)
    phase, views = rng.uniform(0, 2 * np.pi), []
    for k in range(count):
        angle, up = phase + k * TURN, np.interp((k + 0.5) / count, (0, 1), HEIGHTS)
        radius = 11.0 - 0.3 * up + rng.uniform(-0.3, 0.3)
        eye = np.array([radius * math.cos(angle), radius * math.sin(angle), up])
        target = np.append(rng.uniform(-0.5, 0.5, 2), 2.0)
        views.append(camera(eye, target, k, size, FOCAL, torch.float64))
    return views
