"""Procedural materials: the albedo of surface points."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from abcd_ns.lab.synth.noise import Array, fade, fbm2, fbm3, hash2, mix, noise2, smoothstep

Color = tuple[float, float, float]


@dataclass(frozen=True)
class Material:
    """One surface finish. What the colours and the size mean is up to the kind; see its function."""

    kind: str
    """A key of `KINDS`."""
    base: Color
    """Linear albedo."""
    second: Color
    third: Color
    size: tuple[float, float] = (1.0, 1.0)
    """Metres: of a brick, a tile, a plank, a stripe."""
    salt: float = 0.0
    """Tells apart surfaces of the same finish."""


@dataclass(frozen=True)
class Points:
    """Surface points of one kind, with their materials' parameters spread out to them."""

    uv: Array
    """[n, 2] metres along the surface."""
    position: Array
    """[n, 3] metres."""
    footprint: Array
    """[n] metres that one sample covers."""
    base: Array
    second: Array
    third: Array
    """[n, 3] colours."""
    size: Array
    """[n, 2] metres."""
    salt: Array
    """[n]"""


def _joint(distance: Array, width: float, footprint: Array) -> Array:
    """How much of a footprint is covered by a line of `width`, at `distance` from its middle (box filter)."""
    cover = np.clip((0.5 * (width + footprint) - distance) / np.maximum(footprint, 1e-4), 0, 1)
    return np.minimum(cover, width / np.maximum(footprint, width))


def _cells(p: Points, bond: float, joint: float) -> tuple[Array, Array, Array]:
    """Courses of blocks: (column index, row index, cover of the joints), all [n].

    `bond` is how far each other row is shifted, in blocks.
    """
    width, height = p.size[:, 0], p.size[:, 1]
    row_at = p.uv[:, 1] / height
    row = np.floor(row_at)
    column_at = p.uv[:, 0] / width + bond * (row % 2) + 0.2 * bond * hash2(row, row, p.salt)
    column = np.floor(column_at)
    to_side = (0.5 - np.abs(column_at - column - 0.5)) * width
    to_end = (0.5 - np.abs(row_at - row - 0.5)) * height
    return column, row, _joint(np.minimum(to_side, to_end), joint, p.footprint)


def _blocks(p: Points, bond: float, joint: float, variety: float) -> Array:
    """Blocks between base and third, weathered, with joints of the second colour."""
    column, row, line = _cells(p, bond, joint)
    seen = fade(1 / p.size[:, 0], p.footprint)
    tint = hash2(column, row, p.salt) * seen
    light = hash2(column + 91, row + 37, p.salt) * seen
    wear = fbm2(p.uv[:, 0] + p.salt, p.uv[:, 1] - p.salt, 0.8, 4, p.footprint)
    color = mix(p.base, p.third, 0.5 + 0.5 * tint) * (1 + variety * light + 0.28 * wear)[:, None]
    return mix(color, p.second, line)


def masonry(p: Points) -> Array:
    """Walls: `size` is of a block; moss creeps up from the ground in patches."""
    color = _blocks(p, bond=0.5, joint=0.03, variety=0.16)
    height = p.position[:, 2]
    damp = noise2(p.uv[:, 0] * 1.1 + p.salt, height * 1.6)
    moss = smoothstep(0.25, 0.75, 0.62 - height * 0.75 + 0.5 * damp)
    return mix(color, np.float32([0.12, 0.17, 0.06]), 0.6 * moss)


def paving(p: Points) -> Array:
    """Flagstones with grass growing over them in patches of the colour of meadows."""
    flags = _blocks(p, bond=0.5, joint=0.05, variety=0.14)
    x, y = p.uv[:, 0] + p.salt, p.uv[:, 1] - p.salt
    patch = fbm2(x, y, 0.28, 2, p.footprint) + 0.25 * fbm2(x, y, 2.4, 2, p.footprint)
    return mix(flags, meadow(p), smoothstep(0.10, 0.26, patch))


def meadow(p: Points) -> Array:
    """Grass: dry and lush in patches, with tufts."""
    x, y = p.position[:, 0], p.position[:, 1]
    tufts = fbm2(x, y, 3.5, 3, p.footprint)
    lush = smoothstep(-0.5, 0.5, fbm2(x + 31, y, 0.35, 3, p.footprint))
    dry, green = np.float32([0.24, 0.27, 0.08]), np.float32([0.10, 0.22, 0.045])
    return (dry + (green - dry) * lush[:, None]) * (1 + 0.55 * tufts)[:, None]


def wood(p: Points) -> Array:
    """Planks upright along v, `size[0]` wide, with grain."""
    u, v = p.uv[:, 0], p.uv[:, 1] + p.salt
    plank_at = u / p.size[:, 0]
    plank = np.floor(plank_at)
    shade = hash2(plank, plank, p.salt) * fade(1 / p.size[:, 0], p.footprint)
    grain = noise2(u * 38 + 9 * shade, v * 2.2 + 40 * shade) * fade(38, p.footprint)
    knots = fbm2(u * 3, v, 1.7, 2, p.footprint)
    color = mix(p.base, p.third, 0.5 + 0.5 * shade) * (1 + 0.22 * grain + 0.2 * knots)[:, None]
    gap = (0.5 - np.abs(plank_at - plank - 0.5)) * p.size[:, 0]
    return mix(color, p.second, _joint(gap, 0.018, p.footprint))


def stone(p: Points) -> Array:
    """Solid stone or marble: clouds of base and third, veins of the second."""
    at = p.position + p.salt[:, None]
    cloud = fbm3(at, 1.6, 5, p.footprint)
    vein = 1 - smoothstep(0.0, 0.09, np.abs(fbm3(at + np.float32(9.5), 1.3, 2, p.footprint)))
    color = mix(p.base, p.third, smoothstep(-0.6, 0.6, cloud)) * (1 + 0.32 * cloud)[:, None]
    return mix(color, p.second, 0.5 * vein)


def tiles(p: Points) -> Array:
    """Roof tiles in rows: each row is darker under the edge of the one above."""
    column, row, line = _cells(p, bond=0.5, joint=0.02)
    seen = fade(1 / p.size[:, 1], p.footprint)
    within = p.uv[:, 1] / p.size[:, 1] - row - 0.5
    light = 0.2 * hash2(column, row, p.salt) * seen - 0.35 * within * seen
    color = mix(p.base, p.third, 0.5 + 0.5 * hash2(row, column, p.salt) * seen) * (1 + light)[:, None]
    return mix(color, p.second, line)


def foliage(p: Points) -> Array:
    """Leaves: clumps of base and third, dark gaps of the second."""
    at = p.position + p.salt[:, None]
    clumps = fbm3(at, 2.6, 3, p.footprint)
    leaves = fbm3(at + np.float32(4.7), 8.0, 3, p.footprint)
    color = mix(p.base, p.third, smoothstep(-0.5, 0.5, clumps)) * (1 + 0.8 * leaves)[:, None]
    return mix(color, p.second, 0.75 * smoothstep(0.0, 0.5, -clumps - 0.8 * leaves))


def cloth(p: Points) -> Array:
    """A banner: stripes, chequers or chevrons (chosen by the salt) of base and second, with folds."""
    u, v = p.uv[:, 0] / p.size[:, 0], p.uv[:, 1] / p.size[:, 1]
    design = p.salt.astype(np.int32) % 3
    chequer = np.floor(u) + np.floor(v)
    chevron = np.floor(v + np.abs(u - 2 * np.floor(u / 2) - 1))
    which = np.where(design == 0, np.floor(u), np.where(design == 1, chequer, chevron)) % 2
    folds = 1 + 0.12 * np.sin(u * 5.0 + 0.4 * v)
    weave = 1 + 0.1 * fbm2(p.uv[:, 0], p.uv[:, 1], 12.0, 2, p.footprint)
    return mix(p.base, p.second, which.astype(np.float32)) * (folds * weave)[:, None]


def water(p: Points) -> Array:
    """A still pool: ripples between base and third."""
    ripple = fbm2(p.position[:, 0], p.position[:, 1], 2.2, 3, p.footprint)
    return mix(p.base, p.third, smoothstep(-0.4, 0.6, ripple))


def plain(p: Points) -> Array:
    """Iron, rope, plaster: one colour, a little worn."""
    return p.base * (1 + 0.25 * fbm3(p.position + p.salt[:, None], 2.5, 3, p.footprint))[:, None]


KINDS: dict[str, Callable[[Points], Array]] = {
    f.__name__: f for f in (masonry, paving, meadow, wood, stone, tiles, foliage, cloth, water, plain)
}


class MaterialTable:
    """All materials of a scene; a triangle refers to one by its row."""

    def __init__(self) -> None:
        self._materials: list[Material] = []

    def add(self, material: Material) -> int:
        """Append one and return its row."""
        self._materials.append(material)
        return len(self._materials) - 1

    def albedo(
        self, rows: NDArray[np.int32], uv: Array, position: Array, footprint: Array
    ) -> NDArray[np.float32]:
        """The linear albedo [n, 3], within 0.01 .. 0.95, of points with materials `rows` [n]."""
        names = list(KINDS)
        kinds = np.array([names.index(m.kind) for m in self._materials])
        columns = {
            name: np.array([getattr(m, name) for m in self._materials], np.float32)
            for name in ("base", "second", "third", "size", "salt")
        }
        result = np.zeros((len(rows), 3), np.float32)
        kind_of = kinds[rows]
        for k in np.unique(kind_of):
            chosen = np.flatnonzero(kind_of == k)
            spread = {name: column[rows[chosen]] for name, column in columns.items()}
            points = Points(uv[chosen], position[chosen], footprint[chosen], **spread)
            result[chosen] = KINDS[names[k]](points)
        return np.clip(result, 0.01, 0.95)
