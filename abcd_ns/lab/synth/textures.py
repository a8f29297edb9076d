"""Procedural materials: the albedo of surface points."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from abcd_ns.lab.synth.noise import Array, fade, fbm2, fbm3, hash2, mix, smoothstep

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
    """Metres: of a brick, a tile, a plank, a stripe, a cloud."""
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


def blocks(p: Points) -> Array:
    """Masonry, planks, tiles: blocks of `size` between base and third, with joints of the second colour."""
    width, height = p.size[:, 0], p.size[:, 1]
    row_at = p.uv[:, 1] / height
    row = np.floor(row_at)
    column_at = p.uv[:, 0] / width + 0.5 * (row % 2) + 0.1 * hash2(row, row, p.salt)
    column = np.floor(column_at)
    to_side = (0.5 - np.abs(column_at - column - 0.5)) * width
    to_end = (0.5 - np.abs(row_at - row - 0.5)) * height
    line = _joint(np.minimum(to_side, to_end), 0.03, p.footprint)
    seen = fade(1 / width, p.footprint)
    tint, light = hash2(column, row, p.salt) * seen, hash2(column + 91, row + 37, p.salt) * seen
    wear = fbm2(p.uv[:, 0] + p.salt, p.uv[:, 1] - p.salt, 0.8, 2, p.footprint)
    color = mix(p.base, p.third, 0.5 + 0.5 * tint) * (1 + 0.1 * light + 0.2 * wear)[:, None]
    return mix(color, p.second, 0.6 * line)


def paving(p: Points) -> Array:
    """Flagstones with grass growing over them in patches of the colour of meadows."""
    x, y = p.uv[:, 0] + p.salt, p.uv[:, 1] - p.salt
    patch = fbm2(x, y, 0.28, 2, p.footprint) + 0.2 * fbm2(x, y, 2.4, 2, p.footprint)
    return mix(blocks(p), meadow(p), smoothstep(0.10, 0.26, patch))


def meadow(p: Points) -> Array:
    """Grass: dry and lush in patches, with tufts."""
    x, y = p.position[:, 0], p.position[:, 1]
    tufts = fbm2(x, y, 1.8, 3, p.footprint)
    lush = smoothstep(-0.5, 0.5, fbm2(x + 31, y, 0.35, 3, p.footprint))
    dry, green = np.float32([0.24, 0.27, 0.08]), np.float32([0.10, 0.22, 0.045])
    return (dry + (green - dry) * lush[:, None]) * (1 + 0.3 * tufts)[:, None]


def clouds(p: Points) -> Array:
    """Stone, leaves, water, paint: base and third in clouds of `size`, the second in the darkest places."""
    scale = p.size[:, 0]
    cloud = fbm3((p.position + p.salt[:, None]) / scale[:, None], 1.0, 3, p.footprint / scale)
    color = mix(p.base, p.third, smoothstep(-0.6, 0.6, cloud)) * (1 + 0.25 * cloud)[:, None]
    return mix(color, p.second, 0.6 * smoothstep(0.2, 0.7, -cloud))


def cloth(p: Points) -> Array:
    """A banner: stripes, chequers or chevrons (chosen by the salt) of base and second."""
    u, v = p.uv[:, 0] / p.size[:, 0], p.uv[:, 1] / p.size[:, 1]
    design = p.salt.astype(np.int32) % 3
    chevron = np.floor(v + np.abs(u - 2 * np.floor(u / 2) - 1))
    which = np.where(design == 0, np.floor(u), np.where(design == 1, np.floor(u) + np.floor(v), chevron)) % 2
    return mix(p.base, p.second, which.astype(np.float32))


KINDS: dict[str, Callable[[Points], Array]] = {f.__name__: f for f in (blocks, paving, meadow, clouds, cloth)}


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
