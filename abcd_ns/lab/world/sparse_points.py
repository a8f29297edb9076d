"""Scene points with their observations, as structure from motion would leave them, and the model of these."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from nerfstudio.data.utils import colmap_parsing_utils as colmap
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
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
    """P points and who observes them."""

    xyz: NDArray[np.float64]
    """[P, 3] metres, world."""
    rgb: NDArray[np.uint8]
    """[P, 3] sRGB."""
    seen: list[tuple[NDArray[np.int64], NDArray[np.float64]]]
    """By camera: which points it observes, ascending, and where, [n, 2] in pixels (pixel centres at +0.5)."""


def court_points(world: SunlitWorld, views: list[View], count: int, rng: np.random.Generator) -> SparsePoints:
    """About `count` points, each seen by at least two cameras; fewer where the views overlap too little."""
    tries = int(np.ceil(1.6 * count / len(views)))
    drawn = [_through_pixels(world, view, tries, rng) for view in views]
    xyz, rgb, is_sky = (torch.cat(column) for column in zip(*drawn, strict=True))
    seen = [_observe(world, view, xyz) for view in views]
    order = rng.permutation(len(xyz))
    order = order[np.sum([visible for visible, _ in seen], axis=0)[order] >= 2]
    sky_rank = np.cumsum(is_sky.numpy()[order])
    order = order[~is_sky.numpy()[order] | (sky_rank <= _SKY_SHARE * count)][:count]
    found = []
    for visible, xy in seen:
        rows = np.flatnonzero(visible[order])
        found.append((rows, xy[order][rows]))
    return SparsePoints(xyz.numpy()[order], rgb.numpy()[order], found)


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


def write_model(folder: Path, cameras: dict[str, View], sparse: SparsePoints) -> None:
    """Write cameras.bin, images.bin and points3D.bin with one shared pinhole camera, by the writer that
    nerfstudio has of COLMAP's own.

    Ids count from 1: image i is the i-th of `cameras`, by its file's name. Stored errors are 0, because
    observations are exact projections.
    """
    folder.mkdir(parents=True, exist_ok=True)
    tracks: list[list[tuple[int, int]]] = [[] for _ in sparse.xyz]
    images, points = {}, {}
    for i, (name, view) in enumerate(cameras.items()):
        rows, xy = sparse.seen[i]
        for slot, row in enumerate(rows.tolist()):
            tracks[row].append((i + 1, slot))
        turn = Rotation.from_matrix(view.viewmat[:3, :3].numpy()).as_quat(canonical=True)
        pose = turn[[3, 0, 1, 2]], view.viewmat[:3, 3]
        images[i] = colmap.Image(i + 1, *pose, 1, name, xy, rows + 1)
    for j, track in enumerate(tracks):
        points[j] = colmap.Point3D(j + 1, sparse.xyz[j], sparse.rgb[j], 0.0, *np.array(track).T)
    view = next(iter(cameras.values()))
    (fx, _, cx), (_, fy, cy), _ = view.K.tolist()
    shared = colmap.Camera(1, "PINHOLE", view.width, view.height, (fx, fy, cx, cy))
    colmap.write_model({1: shared}, images, points, folder)
