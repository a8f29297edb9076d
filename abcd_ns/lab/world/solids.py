"""Solids that rays meet: balls, blocks and tubes, stretched, turned, and with others cut out of them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.lab.world.textures import Material
from abcd_ns.lab.world.world import FAR

Rays = Float[Tensor, "3 n"]
"""Places or directions; one column serves for all rays."""


def turned(yaw: float = 0.0, tilt: float = 0.0) -> Float[Tensor, "3 3"]:
    """A solid's own axes as rows: tilted by so many radians about x, then turned about z."""
    c, s = math.cos(yaw), math.sin(yaw)
    a, b = math.cos(tilt), math.sin(tilt)
    return torch.tensor([[c, s, 0.0], [-s * a, c * a, b], [s * b, -c * b, a]])


@dataclass(frozen=True, eq=False)
class Solid:
    """A unit shape, stretched to `half` along its own axes."""

    shape: Literal["ball", "block", "tube"]
    """Tubes stand along their z axis."""
    half: tuple[float, float, float]
    """Metres from the middle to the border."""
    material: Material
    center: tuple[float, float, float]
    frame: Float[Tensor, "3 3"]
    """Its axes, rows, in the world."""
    holes: tuple["Solid", ...] = ()

    def placed(self, offset: Sequence[float] = (0.0, 0.0, 0.0), yaw: float = 0.0) -> "Solid":
        """Turned about the z axis of the world, and then moved, with its holes."""
        turn = turned(yaw)
        center = turn.T @ torch.tensor(self.center).float() + torch.tensor([float(x) for x in offset])
        holes = tuple(hole.placed(offset, yaw) for hole in self.holes)
        return replace(self, center=tuple(center.tolist()), frame=self.frame @ turn, holes=holes)

    @cached_property
    def _to_unit(self) -> tuple[list[list[float]], list[float]]:
        """Matrix and offset of the map into the unit shape."""
        matrix = self.frame / torch.tensor(self.half).float()[:, None]
        return matrix.tolist(), (matrix * torch.tensor(self.center).float()).sum(dim=1).tolist()

    def span(self, origins: Rays, directions: Rays) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
        """Where lines enter and leave it, holes left aside, in lengths of the direction; (FAR, -FAR) if not.

        Elementwise: the bits of a ray do not depend on the others that it is traced with.
        """
        matrix, offset = self._to_unit
        p = [weighted(row, origins) - shift for row, shift in zip(matrix, offset, strict=True)]
        v = [weighted(row, directions) for row in matrix]
        enter, leave = slabs(p, v, {"ball": (), "tube": (2,), "block": (0, 1, 2)}[self.shape])
        if self.shape != "block":
            p, v = p[: 3 if self.shape == "ball" else 2], v[: 3 if self.shape == "ball" else 2]
            a = sum(x * x for x in v).clamp_min(1e-12)
            b, c = sum(x * y for x, y in zip(p, v, strict=True)), sum(x * x for x in p) - 1
            inside = b * b - a * c
            root = inside.clamp_min(0).sqrt()
            enter = torch.where(inside > 0, enter.maximum((-b - root) / a), FAR)
            leave = leave.minimum((-b + root) / a)
        missed = enter >= leave
        return torch.where(missed, FAR, enter), torch.where(missed, -FAR, leave)

    def meet(self, origins: Rays, directions: Rays) -> Float[Tensor, "n"]:
        """How far along each ray it is: behind the holes that are met before; FAR where it is not."""
        t, leave = self.span(origins, directions)
        t = t.clamp_min(1e-4)  # rays may begin in a hole
        rows = (t < leave).nonzero()[:, 0] if self.holes else ()
        if len(rows):
            within = t[rows]
            spans = [hole.span(_of(origins, rows), _of(directions, rows)) for hole in self.holes]
            for begin, end in spans * 2:  # again: holes may overlap
                within = torch.where((begin <= within) & (within < end), end, within)
            t = t.index_copy(0, rows, within)
        return torch.where(t < leave, t, FAR)

    def surface(self, places: Rays) -> tuple[Rays, Float[Tensor, "2 n"]]:
        """Of places on it: unit normals out of it, and texture coordinates, metres along the surface."""
        gap, normal, uv = self._skin(places)
        for hole in self.holes:
            near, inner, inner_uv = hole._skin(places)
            mine = near.abs() < gap.abs()
            gap, normal = torch.where(mine, near, gap), torch.where(mine, -inner, normal)
            uv = torch.where(mine, inner_uv, uv)
        return normal, uv

    def _skin(self, places: Rays) -> tuple[Float[Tensor, "n"], Rays, Float[Tensor, "2 n"]]:
        """How far off its skin places are, relative; the normal and texture coordinates there."""
        half = torch.tensor(self.half).float()[:, None]
        at = [place - c for place, c in zip(places, self.center, strict=True)]
        at = torch.stack([weighted(axis, at) for axis in self.frame.tolist()])
        unit = at / half
        gaps = unit.abs() - 1
        if self.shape == "ball":
            gap, normal, uv = unit.norm(dim=0) - 1, unit / half, at[:2]
        elif self.shape == "tube":
            side = unit[:2].norm(dim=0) - 1
            on_top = gaps[2].abs() < side.abs()
            gap = torch.where(on_top, gaps[2], side)
            around = torch.atan2(unit[1], unit[0]) * self.half[0]
            flat = torch.zeros_like(unit[2])
            normal = torch.where(
                on_top,
                torch.stack([flat, flat, unit[2].sign()]),
                torch.stack([unit[0] / self.half[0], unit[1] / self.half[1], flat]),
            )
            uv = torch.where(on_top, at[:2], torch.stack([around, at[2]]))
        else:
            axis = gaps.abs().argmin(dim=0)
            gap = gaps.gather(0, axis[None])[0]
            normal = torch.zeros_like(unit).scatter(0, axis[None], unit.gather(0, axis[None]).sign())
            others = torch.tensor([[1, 0, 0], [2, 2, 1]])[:, axis]
            uv = at.gather(0, others)
        normal = normal * normal.square().sum(dim=0).clamp_min(1e-18).rsqrt()
        return gap, torch.stack([weighted(column, normal) for column in self.frame.T.tolist()]), uv


def ball(center: Sequence[float], radius: float, material: Material, high: float | None = None) -> Solid:
    """A ball, or one `high` metres from its middle to its top."""
    return Solid("ball", (radius, radius, high or radius), material, tuple(center), turned())


def block(low: Sequence[float], high: Sequence[float], material: Material, *holes: Solid) -> Solid:
    """An upright block between two corners."""
    half = tuple((b - a) / 2 for a, b in zip(low, high, strict=True))
    center = tuple((b + a) / 2 for a, b in zip(low, high, strict=True))
    return Solid("block", half, material, center, turned(), holes)


def tube(radius: float, low: float, high: float, material: Material, *holes: Solid) -> Solid:
    """An upright tube around the z axis."""
    half = (radius, radius, (high - low) / 2)
    return Solid("tube", half, material, (0.0, 0.0, (low + high) / 2), turned(), holes)


@dataclass(frozen=True, eq=False)
class Thing:
    """What stands together, in an upright box that rays are tried with first."""

    parts: tuple["Solid | Thing", ...]

    def placed(self, offset: Sequence[float] = (0.0, 0.0, 0.0), yaw: float = 0.0) -> "Thing":
        """As Solid.placed."""
        return Thing(tuple(part.placed(offset, yaw) for part in self.parts))

    @cached_property
    def solids(self) -> tuple[Solid, ...]:
        """All of them, in order."""
        parts = (part.solids if isinstance(part, Thing) else (part,) for part in self.parts)
        return tuple(solid for found in parts for solid in found)

    @cached_property
    def bounds(self) -> tuple[Float[Tensor, "3 1"], Float[Tensor, "3 1"]]:
        """The box: its middle, and half its sides, metres."""
        centers = torch.tensor([solid.center for solid in self.solids]).float()
        halves = torch.tensor([solid.half for solid in self.solids]).float()
        reach = (torch.stack([solid.frame for solid in self.solids]).abs() * halves[:, :, None]).sum(dim=1)
        low, high = (centers - reach).amin(dim=0), (centers + reach).amax(dim=0)
        return (low + high)[:, None] / 2, (high - low)[:, None] / 2 + 1e-3

    def meet(self, origins: Rays, directions: Rays, t: Tensor, which: Tensor, first: int = 0) -> None:
        """Lower `t` to where rays meet what stands here, and note in `which` the number of the solid.

        Args:
            t: [n] how far each ray comes so far, in lengths of its direction; so far is looked.
            first: number of the first solid here.
        """
        middle, half = self.bounds
        enter, leave = slabs((origins - middle) / half, directions / half, (0, 1, 2))
        rows = ((enter < leave) & (leave > 0) & (enter < t)).nonzero()[:, 0]
        if not len(rows):
            return
        start, ahead, mine, number = _of(origins, rows), _of(directions, rows), t[rows], which[rows]
        for part in self.parts:
            if isinstance(part, Thing):
                part.meet(start, ahead, mine, number, first)
                first += len(part.solids)
                continue
            found = part.meet(start, ahead)
            number = torch.where(found < mine, first, number)
            mine = mine.minimum(found)
            first += 1
        t[rows], which[rows] = mine, number


def weighted(weights: Sequence, rows: Sequence[Tensor]) -> Tensor:
    """The sum of three rows, each times its weight."""
    return weights[0] * rows[0] + weights[1] * rows[1] + weights[2] * rows[2]


def slabs(p: Sequence[Tensor], v: Sequence[Tensor], axes: Sequence[int]) -> tuple[Tensor, Tensor]:
    """Where lines p + t v enter and leave what lies between -1 and 1 along each of these axes."""
    enter = torch.full_like(p[0] + v[0], -FAR)
    leave = -enter
    for axis in axes:
        step = torch.where(v[axis].abs() < 1e-9, 1e-9, v[axis]).reciprocal()
        middle, half = -p[axis] * step, step.abs()
        enter, leave = enter.maximum(middle - half), leave.minimum(middle + half)
    return enter, leave


def _of(rays: Rays, rows: Tensor) -> Rays:
    return rays if rays.shape[1] == 1 else rays[:, rows]
