"""Triangle soups with texture coordinates, and the few solids that the scene is made of.

All solids stand in local coordinates in metres, z up, and are then placed by `Soup.placed`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

ALL_FACES = ("-x", "+x", "-y", "+y", "-z", "+z")
STANDING = ("-x", "+x", "-y", "+y", "+z")
"""The faces of a box that stands on something."""


@dataclass(frozen=True)
class Soup:
    """T triangles, each with its own three corners."""

    corners: NDArray[np.float32]
    """[T, 3, 3] corner positions, metres."""
    normals: NDArray[np.float32]
    """[T, 3, 3] unit normals at the corners, pointing out of the solid."""
    uv: NDArray[np.float32]
    """[T, 3, 2] texture coordinates, metres along the surface."""
    material: NDArray[np.int32]
    """[T] rows of the material table."""

    def __len__(self) -> int:
        return len(self.corners)

    def placed(self, offset: Sequence[float] = (0.0, 0.0, 0.0), yaw: float = 0.0) -> "Soup":
        """Turned by `yaw` radians about z, then moved by `offset`."""
        c, s = np.cos(yaw), np.sin(yaw)
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        corners = np.einsum("ij,tcj->tci", turn, self.corners.astype(np.float64)) + np.asarray(offset)
        normals = np.einsum("ij,tcj->tci", turn, self.normals.astype(np.float64))
        return replace(self, corners=corners.astype(np.float32), normals=normals.astype(np.float32))

    @staticmethod
    def cat(parts: Sequence["Soup"]) -> "Soup":
        """All parts in one soup, in order. `parts` must not be empty."""
        names = ("corners", "normals", "uv", "material")
        return Soup(**{name: np.concatenate([getattr(p, name) for p in parts]) for name in names})


def _grid_triangles(points: NDArray, normals: NDArray, uv: NDArray, material: int) -> Soup:
    """Two triangles per cell of a grid of [a, b, ...] samples."""

    def split(values: NDArray) -> NDArray[np.float32]:
        p, q, r, s = values[:-1, :-1], values[1:, :-1], values[1:, 1:], values[:-1, 1:]
        pairs = np.stack([p, q, r, p, r, s], axis=2)
        return pairs.reshape(-1, 3, values.shape[-1]).astype(np.float32)

    corners = split(points)
    return Soup(corners, split(normals), split(uv), np.full(len(corners), material, np.int32))


def _without_slivers(soup: Soup) -> Soup:
    """Drop the triangles that have no area, as those at the poles of a solid of revolution."""
    edges = soup.corners[:, 1:] - soup.corners[:, :1]
    keep = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) > 1e-7
    return Soup(soup.corners[keep], soup.normals[keep], soup.uv[keep], soup.material[keep])


def _planar_uv(points: NDArray, normal: NDArray) -> NDArray:
    """Texture coordinates by projection along the axis that `normal` is closest to; v is z on walls."""
    axis = int(np.argmax(np.abs(normal)))
    return points[..., ((1, 2), (0, 2), (0, 1))[axis]]


def patch(corners: NDArray, outward: NDArray, material: int, max_edge: float) -> Soup:
    """A bilinear patch over four corners [4, 3] in order around it, cut so that no edge exceeds `max_edge`.

    The cuts carry the baked ambient light, which is interpolated between vertices.
    """
    p, q, r, s = np.asarray(corners, np.float64)
    n_u = max(1, math.ceil(max(math.dist(p, q), math.dist(s, r)) / max_edge - 1e-9))
    n_v = max(1, math.ceil(max(math.dist(p, s), math.dist(q, r)) / max_edge - 1e-9))
    a = np.linspace(0, 1, n_u + 1)[:, None, None]
    b = np.linspace(0, 1, n_v + 1)[None, :, None]
    points = (1 - a) * (1 - b) * p + a * (1 - b) * q + a * b * r + (1 - a) * b * s
    normal = np.cross(r - p, s - q)
    normal /= np.linalg.norm(normal)
    if normal @ outward < 0:
        normal = -normal
    return _grid_triangles(
        points, np.broadcast_to(normal, points.shape), _planar_uv(points, normal), material
    )


def hexahedron(
    bottom: NDArray, top: NDArray, material: int, max_edge: float = 0.6, faces: Sequence[str] = ALL_FACES
) -> Soup:
    """A box with free corners: `bottom` and `top` [4, 3] at (-x,-y), (+x,-y), (+x,+y), (-x,+y)."""
    b, t = np.asarray(bottom, np.float64), np.asarray(top, np.float64)
    sides = {
        "-x": (b[0], b[3], t[3], t[0]),
        "+x": (b[1], b[2], t[2], t[1]),
        "-y": (b[0], b[1], t[1], t[0]),
        "+y": (b[3], b[2], t[2], t[3]),
        "-z": tuple(b),
        "+z": tuple(t),
    }
    middle = np.concatenate([b, t]).mean(axis=0)
    quads = [np.array(sides[name]) for name in faces]
    return Soup.cat([patch(quad, quad.mean(axis=0) - middle, material, max_edge) for quad in quads])


def box(
    low: Sequence[float],
    high: Sequence[float],
    material: int,
    max_edge: float = 0.6,
    faces: Sequence[str] = ALL_FACES,
) -> Soup:
    """An axis-aligned box between two corners."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    base = np.array([[x0, y0, z0], [x1, y0, z0], [x1, y1, z0], [x0, y1, z0]], np.float64)
    return hexahedron(base, base + np.array([0, 0, z1 - z0]), material, max_edge, faces)


def lathe(profile: Sequence[tuple[float, float]], material: int, segments: int = 16) -> Soup:
    """The solid that a profile of (radius, z), given from the bottom up, sweeps around the z axis."""
    rz = np.asarray(profile, np.float64)
    step = np.diff(rz, axis=0)
    length = np.linalg.norm(step, axis=1)
    slope = np.stack([step[:, 1], -step[:, 0]], axis=1) / length[:, None]
    arc = np.concatenate([[0.0], np.cumsum(length)])
    angle = np.linspace(0, 2 * np.pi, segments + 1)
    parts = []
    for k in range(len(step)):
        ring, normal = rz[k : k + 2], slope[[k, k]]
        around = np.stack([np.cos(angle), np.sin(angle)], axis=1)[:, None, :]
        points = _swept(around, ring)
        u = np.broadcast_to(angle[:, None] * rz[:, 0].max(), points.shape[:2])
        uv = np.stack([u, np.broadcast_to(arc[k : k + 2], points.shape[:2])], axis=-1)
        parts.append(_grid_triangles(points, _swept(around, normal), uv, material))
    return _without_slivers(Soup.cat(parts))


def _swept(around: NDArray, rz: NDArray) -> NDArray:
    """[a, 1, 2] directions and [2, 2] (radius, z) to [a, 2, 3] points or normals."""
    flat = around * rz[None, :, :1]
    return np.concatenate([flat, np.broadcast_to(rz[None, :, 1:], (*flat.shape[:2], 1))], axis=-1)


def ball(radius: float, material: int) -> Soup:
    """A sphere about the origin."""
    return blob(radius, 0.0, material, np.random.default_rng(0))


def blob(
    radius: float,
    roughness: float,
    material: int,
    rng: np.random.Generator,
    rings: int = 8,
    segments: int = 16,
) -> Soup:
    """A lumpy ball (foliage, rock): r(d) = radius (1 + 2 roughness lump(d)) in direction d.

    The normal of such a surface is along r d - grad r, with the part of the gradient across d.
    """
    tilt = np.linspace(-np.pi / 2, np.pi / 2, rings + 1)[None, :, None]
    turn = np.linspace(0, 2 * np.pi, segments + 1)[:, None, None]
    d = np.concatenate(
        [np.cos(turn) * np.cos(tilt), np.sin(turn) * np.cos(tilt), np.sin(tilt) + 0 * turn], axis=-1
    )
    waves, phase = rng.normal(size=(6, 3)) * 2.5, rng.uniform(0, 2 * np.pi, 6)
    argument = np.einsum("abi,wi->abw", d, waves) + phase
    r = radius * (1 + 2 * roughness * np.sin(argument).mean(axis=-1, keepdims=True))
    slope = radius * 2 * roughness * np.einsum("abw,wi->abi", np.cos(argument), waves) / len(waves)
    slope -= (slope * d).sum(axis=-1, keepdims=True) * d
    normal = r * d - slope
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return _without_slivers(_grid_triangles(r * d, normal, d[..., :2] * radius, material))
