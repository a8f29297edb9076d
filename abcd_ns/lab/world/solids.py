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
    def cut(self) -> "Lines":
        """Through its holes."""
        return Lines(self.holes)

    def first(
        self, t: Float[Tensor, "n"], leave: Float[Tensor, "n"], origins: Rays, directions: Rays
    ) -> Float[Tensor, "n"]:
        """Where rays meet it that enter the whole shape at `t`: behind the holes that they meet before."""
        rows = (t < leave).nonzero()[:, 0] if self.holes else ()
        if len(rows):
            begin, end = self.cut.spans(_of(origins, rows), _of(directions, rows))
            within = t[rows]
            for k in [*range(len(self.holes))] * 2:  # again: holes may overlap
                within = torch.where((begin[k] <= within) & (within < end[k]), end[k], within)
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


class Lines:
    """Where lines enter and leave each of some solids, holes left aside; those of one shape at a time."""

    def __init__(self, solids: Sequence[Solid]) -> None:
        self._count, self._kinds = len(solids), []
        for shape in ("ball", "tube", "block"):
            rows = [k for k, solid in enumerate(solids) if solid.shape == shape]
            if rows:
                halves = torch.tensor([solids[k].half for k in rows]).float()
                matrix = torch.stack([solids[k].frame for k in rows]) / halves[:, :, None]
                centers = torch.tensor([solids[k].center for k in rows]).float()
                self._kinds.append(
                    (shape, torch.tensor(rows), matrix, (matrix * centers[:, None]).sum(dim=2))
                )

    def spans(self, origins: Rays, directions: Rays) -> tuple[Float[Tensor, "s n"], Float[Tensor, "s n"]]:
        """In lengths of the direction, by solid and line; (FAR, -FAR) where it misses."""
        count = directions.shape[1] if origins.shape[1] == 1 else origins.shape[1]
        entered, left = origins.new_full((2, self._count, count), FAR)
        for shape, rows, matrix, shift in self._kinds:
            # Elementwise: the bits of a ray do not hang on which others it is traced with.
            p = [weighted(matrix[:, k].T[..., None], origins) - shift[:, k, None] for k in range(3)]
            v = [weighted(matrix[:, k].T[..., None], directions) for k in range(3)]
            enter, leave = slabs(p, v, {"ball": (), "tube": (2,), "block": (0, 1, 2)}[shape])
            if shape != "block":
                p, v = p[: 3 if shape == "ball" else 2], v[: 3 if shape == "ball" else 2]
                a = sum(x * x for x in v).clamp_min(1e-12)
                b, c = sum(x * y for x, y in zip(p, v, strict=True)), sum(x * x for x in p) - 1
                inside = b * b - a * c
                root = inside.clamp_min(0).sqrt()
                enter = torch.where(inside > 0, enter.maximum((-b - root) / a), FAR)
                leave = leave.minimum((-b + root) / a)
            missed = enter >= leave
            entered[rows], left[rows] = torch.where(missed, FAR, enter), torch.where(missed, -FAR, leave)
        return entered, left


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
        places = iter(zip(*self._lines.spans(start, ahead), strict=True)) if self._here else iter(())
        for part in self.parts:
            if isinstance(part, Thing):
                part.meet(start, ahead, mine, number, first)
                first += len(part.solids)
                continue
            enter, leave = next(places)
            found = part.first(
                enter.clamp_min(1e-4), leave, start, ahead
            )  # who stands in a hole sees the hole
            number = torch.where(found < mine, first, number)
            mine = mine.minimum(found)
            first += 1
        t[rows], which[rows] = mine, number

    @cached_property
    def _here(self) -> list[Solid]:
        return [part for part in self.parts if isinstance(part, Solid)]

    @cached_property
    def _lines(self) -> Lines:
        return Lines(self._here)


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
