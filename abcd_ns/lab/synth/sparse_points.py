"""Scene points with their observations, as a structure-from-motion run would leave them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from abcd_ns.lab.synth.cameras import Camera, Lens
from abcd_ns.lab.synth.render import camera_rays, pixel_angle, to_bytes
from abcd_ns.lab.synth.world import World

_SKY_SHARE = 0.1
"""At most this share of the points lies on the dome."""
_MARGIN = 1.0
"""Pixels from the border of an image within which nothing is observed."""
_SLACK = 1e-3
"""Relative depth by which a point may lie behind the surface that hides it; float32 rays need some."""


@dataclass(frozen=True)
class SparsePoints:
    """P points and their O observations."""

    xyz: NDArray[np.float64]
    """[P, 3] metres, world."""
    rgb: NDArray[np.uint8]
    """[P, 3] sRGB."""
    point: NDArray[np.int64]
    """[O] which point is observed."""
    camera: NDArray[np.int64]
    """[O] index of the camera that sees it, in the list of all cameras."""
    xy: NDArray[np.float64]
    """[O, 2] where, in pixels (pixel centres at +0.5)."""

    @staticmethod
    def cat(parts: list["SparsePoints"]) -> "SparsePoints":
        """All parts in one, points numbered through."""
        starts = np.cumsum([0] + [len(p.xyz) for p in parts[:-1]])
        return SparsePoints(
            np.concatenate([p.xyz for p in parts]),
            np.concatenate([p.rgb for p in parts]),
            np.concatenate([p.point + s for p, s in zip(parts, starts, strict=True)]),
            np.concatenate([p.camera for p in parts]),
            np.concatenate([p.xy for p in parts]),
        )


def court_points(
    world: World, cameras: list[Camera], own: range, nearby: list[int], lens: Lens, count: int
) -> SparsePoints:
    """About `count` points that the cameras `own` of one court see, each in at least two cameras.

    Args:
        cameras: all cameras of the scene.
        own: indices of the court's cameras, through whose pixels the points are drawn.
        nearby: indices of every camera that may observe them, `own` included.
        count: wanted number of points; fewer where the views overlap too little.
    """
    rng = world.site.rng("points", cameras[own[0]].court)
    tries = 1.6 * count / len(own)
    drawn = [_through_pixels(world, cameras[c], lens, int(np.ceil(tries)), rng) for c in own]
    xyz, rgb, is_sky = (np.concatenate(column) for column in zip(*drawn, strict=True))
    seen = [_observe(world, cameras[c], lens, xyz) for c in nearby]
    views = np.sum([visible for visible, _ in seen], axis=0)
    order = rng.permutation(len(xyz))
    order = order[views[order] >= 2]
    sky_rank = np.cumsum(is_sky[order])
    order = order[~is_sky[order] | (sky_rank <= _SKY_SHARE * count)][:count]
    points, at, where = [], [], []
    for c, (visible, xy) in zip(nearby, seen, strict=True):
        mine = np.flatnonzero(visible[order])
        points.append(mine)
        at.append(np.full(len(mine), c))
        where.append(xy[order][mine])
    return SparsePoints(
        xyz[order], rgb[order], np.concatenate(points), np.concatenate(at), np.concatenate(where)
    )


def _through_pixels(
    world: World, camera: Camera, lens: Lens, count: int, rng: np.random.Generator
) -> tuple[NDArray, NDArray, NDArray]:
    """Points on what a camera sees: positions [n, 3], true colours [n, 3], and whether of the sky [n]."""
    span = np.array([lens.width, lens.height]) - 2 * _MARGIN
    xy = _MARGIN + rng.uniform(size=(count, 2)) * span
    origins, directions = camera_rays(camera, lens, xy)
    sight = world.look(origins, directions, pixel_angle(lens, 1))
    xyz = camera.center + directions.astype(np.float64) * sight.distance.astype(np.float64)[:, None]
    return xyz, to_bytes(sight.radiance), sight.is_sky


def _observe(world: World, camera: Camera, lens: Lens, xyz: NDArray) -> tuple[NDArray, NDArray]:
    """Whether a camera sees each point, by a ray to it [n], and where in the image [n, 2]."""
    xy, z = camera.project(xyz, lens)
    low, high = _MARGIN, np.array([lens.width, lens.height]) - _MARGIN
    visible = (z > 0.05) & (xy > low).all(axis=1) & (xy < high).all(axis=1)
    candidates = np.flatnonzero(visible)
    ray = (xyz[candidates] - camera.center).astype(np.float32)
    start = np.broadcast_to(camera.center.astype(np.float32), ray.shape)
    reach = np.full(len(ray), 1 - _SLACK, np.float32)
    visible[candidates] = ~world.caster.blocked(start, ray, reach)
    return visible, xy
