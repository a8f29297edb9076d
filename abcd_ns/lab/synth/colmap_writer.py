"""COLMAP's binary model, by the writer that nerfstudio has of COLMAP's own."""

from pathlib import Path

import numpy as np
from nerfstudio.data.utils import colmap_parsing_utils as colmap
from scipy.spatial.transform import Rotation

from abcd_ns.engine.types import View
from abcd_ns.lab.synth.sparse_points import SparsePoints


def write_model(folder: Path, cameras: dict[str, View], points: SparsePoints) -> None:
    """Write cameras.bin, images.bin and points3D.bin of a model with one shared pinhole camera.

    Ids count from 1: image i is the i-th of `cameras`, by its file's name; point j is row j - 1 of `points`.
    Stored errors are 0, because observations are exact projections.
    """
    folder.mkdir(parents=True, exist_ok=True)
    order = np.lexsort((points.point, points.camera))
    rows = np.searchsorted(points.camera[order], np.arange(len(cameras) + 1))
    slot = np.empty(len(order), np.int64)
    slot[order] = np.arange(len(order)) - rows[points.camera[order]]
    images, tracks = {}, {}
    for i, (name, view) in enumerate(cameras.items()):
        mine = order[rows[i] : rows[i + 1]]
        turn = Rotation.from_matrix(view.viewmat[:3, :3].numpy()).as_quat(canonical=True)
        pose = turn[[3, 0, 1, 2]], view.viewmat[:3, 3]
        images[i] = colmap.Image(i + 1, *pose, 1, name, points.xy[mine], points.point[mine] + 1)
    by_point = np.lexsort((points.camera, points.point))
    ends = np.searchsorted(points.point[by_point], np.arange(len(points.xyz) + 1))
    for j, (xyz, rgb) in enumerate(zip(points.xyz, points.rgb, strict=True)):
        track = by_point[ends[j] : ends[j + 1]]
        tracks[j] = colmap.Point3D(j + 1, xyz, rgb, 0.0, points.camera[track] + 1, slot[track])
    view = next(iter(cameras.values()))
    (fx, _, cx), (_, fy, cy), _ = view.K.tolist()
    shared = colmap.Camera(1, "PINHOLE", view.width, view.height, (fx, fy, cx, cy))
    colmap.write_model({1: shared}, images, tracks, folder)
