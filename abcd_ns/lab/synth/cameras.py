"""The cameras that walk the courts."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from abcd_ns.lab.synth.court import Site

_FOCAL_PER_WIDTH = 0.72
"""Focal length over image width: a horizontal field of view of 70 degrees."""
_TURN = 2 * np.pi * (np.sqrt(2) - 1)
"""From one camera to the next. Eight of them, from one held-out view to the next, go around evenly as well;
eight golden angles do not."""
_HEIGHTS = (7.0, 10.5)
"""Metres over the ground: above all towers, so that no camera stands in anything, whatever the court."""


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


def court_cameras(site: Site, court: int, count: int) -> list[Camera]:
    """`count` cameras on a rising spiral above one court's walls, all looking into it.

    Any part of the list looks from all around, and what a held-out view shows is in its neighbours' views.
    """
    rng = site.rng("cameras", court)
    phase, middle = rng.uniform(0, 2 * np.pi), site.center(court)
    cameras = []
    for k in range(count):
        angle, height = phase + k * _TURN, np.interp((k + 0.5) / count, (0, 1), _HEIGHTS)
        radius = 11.0 - 0.3 * height + rng.uniform(-0.3, 0.3)
        at = middle + np.array([radius * np.cos(angle), radius * np.sin(angle), height])
        target = middle + np.append(rng.uniform(-0.5, 0.5, 2), 2.0)
        cameras.append(Camera(f"court{court:03d}_view{k:03d}.png", court, at, look_at(at, target)))
    return cameras
