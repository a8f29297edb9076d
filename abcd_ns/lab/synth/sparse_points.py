"""Scene points with their observations, as a structure-from-motion run would leave them."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from abcd_ns.engine.types import View
from abcd_ns.lab.world.sunlight import SunlitWorld
from abcd_ns.lab.world.world import project, rays_through

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
        columns = {
            name: np.concatenate([getattr(p, name) for p in parts]) for name in ("xyz", "rgb", "camera", "xy")
        }
        points = np.concatenate([p.point + s for p, s in zip(parts, starts, strict=True)])
        return SparsePoints(point=points, **columns)


def court_points(
    world: SunlitWorld, views: list[View], own: range, nearby: list[int], count: int, rng: np.random.Generator
) -> SparsePoints:
    """About `count` points that the cameras `own` of one court see, each in at least two cameras.

    Args:
        views: all cameras of the scene.
        own: indices of the court's cameras, through whose pixels the points are drawn.
        nearby: indices of every camera that may observe them, `own` included.
        count: wanted number of points; fewer where the views overlap too little.
    """
    tries = int(np.ceil(1.6 * count / len(own)))
    drawn = [_through_pixels(world, views[c], tries, rng) for c in own]
    xyz, rgb, is_sky = (torch.cat(column) for column in zip(*drawn, strict=True))
    seen = [_observe(world, views[c], xyz) for c in nearby]
    order = rng.permutation(len(xyz))
    order = order[np.sum([visible for visible, _ in seen], axis=0)[order] >= 2]
    sky_rank = np.cumsum(is_sky.numpy()[order])
    order = order[~is_sky.numpy()[order] | (sky_rank <= _SKY_SHARE * count)][:count]
    found = [np.flatnonzero(visible[order]) for visible, _ in seen]
    return SparsePoints(
        xyz.numpy()[order],
        rgb.numpy()[order],
        np.concatenate(found),
        np.concatenate([np.full(len(mine), c) for c, mine in zip(nearby, found, strict=True)]),
        np.concatenate([xy[order][mine] for (_, xy), mine in zip(seen, found, strict=True)]),
    )


def _through_pixels(
    world: SunlitWorld, view: View, count: int, rng: np.random.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Points on what a camera sees: positions [n, 3], true colours [n, 3], and whether of the sky [n]."""
    span = np.array([view.width, view.height]) - 2 * _MARGIN
    rays = rays_through(view, torch.from_numpy(_MARGIN + rng.uniform(size=(count, 2)) * span))
    seen = world.look(view.center, rays, 1 / float(view.K[0, 0]))
    return seen.places, (255 * seen.colors).round().byte(), ~seen.hit


def _observe(world: SunlitWorld, view: View, xyz: Tensor) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Whether a camera sees each point, by a ray to it [n], and where in the image [n, 2]."""
    xy, z = project(view, xyz)
    high = torch.tensor([view.width, view.height]) - _MARGIN
    visible = (z > 0.05) & (xy > _MARGIN).all(dim=1) & (xy < high).all(dim=1)
    rays = (xyz[visible] - view.center).T.float()
    visible[visible.clone()] = ~world.blocked(view.center.float()[:, None], rays, 1 - _SLACK)
    return visible.numpy(), xy.numpy()
