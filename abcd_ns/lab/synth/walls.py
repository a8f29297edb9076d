"""The four walls of a court, with gates and windows.

A wall is built in a local frame, its inner face towards -y: s = x runs along the wall, z is up. Neighbouring
courts each build their own half of a shared wall; both take the openings from the shared edge, so they match.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from abcd_ns.lab.synth.geometry import STANDING, Soup, box, hexahedron

CELL = 12.0
"""Side of a court, metres, from the middle of one wall to the middle of the next."""
THICKNESS = 0.3
"""Of a court's half of a wall, metres."""
INNER = CELL / 2 - THICKNESS
"""From a court's centre to the inner face of its walls, metres."""
_ARCH_STEPS = 8
_EDGE = 0.8
_SEEN = ("-x", "+x", "-y", "+z")
"""The faces of a pier, but for the outer one, which is never near a camera and stays uncut."""


@dataclass(frozen=True)
class Opening:
    """A gate (sill 0) or window in a wall, with an arched head."""

    center: float
    """Metres along the wall from its middle."""
    width: float
    sill: float
    """Height of the lower edge, metres."""
    spring: float
    """Height where the arch begins, metres."""

    @property
    def left(self) -> float:
        return self.center - self.width / 2

    @property
    def right(self) -> float:
        return self.center + self.width / 2

    @property
    def rise(self) -> float:
        """Height of the arch above its springing, metres."""
        return 0.42 * self.width

    def arch(self, grow: float = 0.0) -> np.ndarray:
        """The arch as points (s, z) from left to right, `grow` metres outside the opening. [steps + 1, 2]"""
        angle = np.linspace(np.pi, 0, _ARCH_STEPS + 1)
        s = self.center + (self.width / 2 + grow) * np.cos(angle)
        return np.stack([s, self.spring + (self.rise + grow) * np.sin(angle)], axis=1)

    def mirrored(self) -> "Opening":
        """As seen from the other side of the wall."""
        return Opening(-self.center, self.width, self.sill, self.spring)


@dataclass(frozen=True)
class WallFinish:
    """Rows of the material table."""

    wall: int
    trim: int


def wall(openings: list[Opening], height: float, finish: WallFinish) -> Soup:
    """One half wall of `height` metres along x, its inner face at y = INNER, with trims and merlons."""
    openings = sorted(openings, key=lambda o: o.center)
    start, end = -CELL / 2, INNER
    parts: list[Soup] = []
    at = start
    for opening in openings:
        parts += _pier(at, opening.left, height, finish)
        parts += _opening(opening, height, finish)
        at = opening.right
    parts += _pier(at, end, height, finish)
    parts.append(box((start, INNER - 0.07, height - 0.16), (end, INNER, height), finish.trim, 1.2))
    parts += _merlons(start, end, height, finish)
    return Soup.cat(parts)


def _pier(s0: float, s1: float, height: float, finish: WallFinish) -> list[Soup]:
    """A full-height stretch of wall with a plinth."""
    return [
        box((s0, INNER, 0), (s1, CELL / 2, height), finish.wall, _EDGE, _SEEN),
        box((s0, INNER, 0), (s1, CELL / 2, height), finish.wall, CELL, ("+y",)),
        box((s0, INNER - 0.08, 0), (s1, INNER, 0.32), finish.trim, 1.2, ("-x", "+x", "-y", "+z")),
    ]


def _opening(o: Opening, height: float, finish: WallFinish) -> list[Soup]:
    """The wall above and below an opening, and its raised frame."""
    y0, y1 = INNER, CELL / 2
    inner, outer = o.arch(), o.arch(grow=0.2)
    parts = []
    for (s0, z0), (s1, z1) in pairwise(inner):
        base = np.array([[s0, y0, z0], [s1, y0, z1], [s1, y1, z1], [s0, y1, z0]])
        top = base * [1, 1, 0] + [0, 0, height]
        parts.append(hexahedron(base, top, finish.wall, _EDGE, ("-y", "+y", "-z", "+z")))
    front = y0 - 0.06
    for k in range(_ARCH_STEPS):
        (a, za), (b, zb) = inner[k], inner[k + 1]
        (c, zc), (d, zd) = outer[k], outer[k + 1]
        base = np.array([[a, front, za], [b, front, zb], [b, y0, zb], [a, y0, za]])
        top = np.array([[c, front, zc], [d, front, zd], [d, y0, zd], [c, y0, zc]])
        parts.append(hexahedron(base, top, finish.trim, 1.5, ("-y", "-z", "+z")))
    for s0, s1 in ((o.left - 0.2, o.left), (o.right, o.right + 0.2)):
        parts.append(box((s0, front, o.sill), (s1, y0, o.spring), finish.trim, 1.2, ("-x", "+x", "-y")))
    if o.sill > 0:
        parts.append(box((o.left, y0, 0), (o.right, y1, o.sill), finish.wall, _EDGE, ("-y", "+y", "+z")))
        parts.append(
            box((o.left - 0.3, y0 - 0.14, o.sill - 0.14), (o.right + 0.3, y0, o.sill), finish.trim, 1.2)
        )
    return parts


def _merlons(start: float, end: float, height: float, finish: WallFinish) -> list[Soup]:
    """Battlements along the top."""
    count = 9
    pitch = (end - start) / count
    left = start + pitch * (np.arange(count) + 0.2)
    return [
        box((s, INNER, height), (s + 0.58 * pitch, CELL / 2, height + 0.55), finish.wall, 1.2, STANDING)
        for s in left
    ]
