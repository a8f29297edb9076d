"""The cameras that walk the courts."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from abcd_ns.lab.synth.court import Site
from abcd_ns.lab.synth.raycast import Caster, spread_directions
from abcd_ns.lab.synth.walls import CELL

_FOCAL_PER_WIDTH = 0.72
"""Focal length over image width: a horizontal field of view of 70 degrees."""
_TRIES = 24
_AIMS = ("across", "gate", "across", "outward", "across", "tangent")


@dataclass(frozen=True)
class Lens:
    """The pinhole that all cameras share; pixel centres at +0.5."""

    width: int
    height: int

    @property
    def focal(self) -> float:
        """In pixels, in x and y alike."""
        return _FOCAL_PER_WIDTH * self.width

    def directions(self, xy: NDArray) -> NDArray:
        """Pixel positions [n, 2] to directions [n, 3] in the camera's frame, with z = 1."""
        x = (xy[:, 0] - self.width / 2) / self.focal
        y = (xy[:, 1] - self.height / 2) / self.focal
        return np.stack([x, y, np.ones_like(x)], axis=1)


@dataclass(frozen=True)
class Camera:
    """One picture to take. OpenCV convention: x right, y down, z forward."""

    name: str
    """Of the image file."""
    court: int
    center: NDArray[np.float64]
    """[3] metres, world."""
    rotation: NDArray[np.float64]
    """[3, 3] world to camera."""

    @property
    def translation(self) -> NDArray[np.float64]:
        """[3] of world to camera."""
        return -self.rotation @ self.center

    def project(self, points: NDArray[np.float64], lens: Lens) -> tuple[NDArray, NDArray]:
        """World points [n, 3] to pixel positions [n, 2] and camera z [n]."""
        local = np.einsum("ij,nj->ni", self.rotation, points - self.center)
        z = local[:, 2]
        safe = np.where(np.abs(z) > 1e-9, z, 1e-9)
        return lens.focal * local[:, :2] / safe[:, None] + [lens.width / 2, lens.height / 2], z


def look_at(center: NDArray, target: NDArray) -> NDArray[np.float64]:
    """The rotation [3, 3] of an upright camera at `center` that looks at `target`."""
    forward = target - center
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1.0])
    right = right / np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def court_cameras(site: Site, court: int, count: int, lens: Lens, caster: Caster) -> list[Camera]:
    """`count` cameras in one court: three quarters on a ring at eye height, the rest higher, looking down.

    A pose too close to a surface is drawn again.
    """
    rng = site.rng("cameras", court)
    high = count // 4
    phase = rng.uniform(0, 2 * np.pi)
    poses = []
    for k in range(count):
        is_high = k >= count - high
        part, whole = (k - (count - high), high) if is_high else (k, count - high)
        angle = phase + 2 * np.pi * part / whole + (0.4 if is_high else 0.0)
        aim = "down" if is_high else _AIMS[k % len(_AIMS)]
        poses.append(_clear_pose(site, court, angle, aim, lens, caster, rng))
    middle = site.center(court)
    return [
        Camera(f"court{court:03d}_view{k:03d}.png", court, middle + at, look_at(at, target))
        for k, (at, target) in enumerate(poses)
    ]


def _clear_pose(
    site: Site, court: int, angle: float, aim: str, lens: Lens, caster: Caster, rng: np.random.Generator
) -> tuple[NDArray, NDArray]:
    """Centre and target, both from the court's middle: the freest of some draws, or the first free enough."""
    best, best_room = None, -1.0
    for _ in range(_TRIES):
        at, target = _draw_pose(site, court, angle, aim, rng)
        room = _room(site.center(court), at, target, lens, caster)
        if room > best_room:
            best, best_room = (at, target), room
        if room >= 1.0:
            break
    return best


def _draw_pose(
    site: Site, court: int, angle: float, aim: str, rng: np.random.Generator
) -> tuple[NDArray, NDArray]:
    """A position near `angle` on the ring, and what to look at from there."""
    angle = angle + rng.uniform(-0.15, 0.15)
    radius, height = rng.uniform(3.3, 4.3), rng.uniform(1.45, 1.9)
    if aim == "down":
        radius, height = rng.uniform(2.9, 4.6), rng.uniform(2.6, 4.6)
    at = np.array([radius * np.cos(angle), radius * np.sin(angle), height])
    if aim == "down":
        far = rng.uniform(-0.4, 1.6)
        return at, np.array([-far * np.cos(angle), -far * np.sin(angle), rng.uniform(0.5, 1.2)])
    if aim == "gate":
        sides = [k for k in range(4) if site.shares_wall(court, k)]
        if sides:
            along = rng.choice(sides) * np.pi / 2 + np.pi / 2
            place = np.array([np.cos(along), np.sin(along)]) * CELL / 2 + rng.uniform(-0.5, 0.5, 2)
            return at, np.append(place, rng.uniform(1.0, 1.5))
    turn = {"outward": rng.uniform(-0.9, 0.9), "tangent": rng.choice([-1, 1]) * rng.uniform(1.2, 1.8)}
    heading = angle + turn.get(aim, np.pi + rng.uniform(-0.5, 0.5))
    pitch = rng.uniform(-0.22, 0.16)
    return at, at + np.array([np.cos(heading), np.sin(heading), np.tan(pitch)])


def _room(middle: NDArray, at: NDArray, target: NDArray, lens: Lens, caster: Caster) -> float:
    """How free a pose is: at 1, half a metre all around it and 1.2 metres in nearly all of the picture."""
    around = spread_directions(40)
    start = np.broadcast_to((middle + at).astype(np.float32), around.shape)
    nearest = float(caster.first_hit(start, around).distance.min())
    steps = np.linspace(0.05, 0.95, 7)
    xy = np.stack(np.meshgrid(steps * lens.width, steps * lens.height), axis=-1).reshape(-1, 2)
    rays = np.einsum("ij,ni->nj", look_at(at, target), lens.directions(xy))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    start = np.broadcast_to((middle + at).astype(np.float32), rays.shape)
    in_view = np.quantile(caster.first_hit(start, rays.astype(np.float32)).distance, 0.1, method="lower")
    return float(min(nearest / 0.5, in_view / 1.2))
