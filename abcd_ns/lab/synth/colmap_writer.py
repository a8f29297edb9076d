"""COLMAP's binary model: https://colmap.github.io/format.html#binary-file-format, little-endian."""

import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from abcd_ns.engine.types import View
from abcd_ns.lab.synth.sparse_points import SparsePoints

_PINHOLE = 1
_CAMERA_ID = 1


def write_model(folder: Path, cameras: dict[str, View], points: SparsePoints) -> None:
    """Write cameras.bin, images.bin and points3D.bin of a model with one shared pinhole camera.

    Ids count from 1: image i is the i-th of `cameras`, by its file's name; point j is row j - 1 of `points`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    order = np.lexsort((points.point, points.camera))
    rows = np.searchsorted(points.camera[order], np.arange(len(cameras) + 1))
    slot = np.empty(len(order), np.int64)
    slot[order] = np.arange(len(order)) - rows[points.camera[order]]
    (folder / "cameras.bin").write_bytes(_camera(next(iter(cameras.values()))))
    with open(folder / "images.bin", "wb") as file:
        file.write(struct.pack("<Q", len(cameras)))
        for i, (name, view) in enumerate(cameras.items()):
            mine = order[rows[i] : rows[i + 1]]
            file.write(_image(i + 1, name, view, points.xy[mine], points.point[mine] + 1))
    with open(folder / "points3D.bin", "wb") as file:
        file.write(struct.pack("<Q", len(points.xyz)))
        by_point = np.lexsort((points.camera, points.point))
        ends = np.searchsorted(points.point[by_point], np.arange(len(points.xyz) + 1))
        for j in range(len(points.xyz)):
            track = by_point[ends[j] : ends[j + 1]]
            file.write(_point(j + 1, points.xyz[j], points.rgb[j], points.camera[track] + 1, slot[track]))


def _camera(view: View) -> bytes:
    shape = struct.pack("<iiQQ", _CAMERA_ID, _PINHOLE, view.width, view.height)
    (fx, _, cx), (_, fy, cy), _ = view.K.tolist()
    return struct.pack("<Q", 1) + shape + struct.pack("<4d", fx, fy, cx, cy)


def _image(number: int, name: str, view: View, xy: NDArray, point_ids: NDArray) -> bytes:
    x, y, z, w = Rotation.from_matrix(view.viewmat[:3, :3].numpy()).as_quat(canonical=True)
    pose = struct.pack("<i7di", number, w, x, y, z, *view.viewmat[:3, 3].tolist(), _CAMERA_ID)
    seen = np.empty(len(xy), [("xy", "<f8", 2), ("id", "<i8")])
    seen["xy"], seen["id"] = xy, point_ids
    return pose + name.encode() + b"\0" + struct.pack("<Q", len(seen)) + seen.tobytes()


def _point(number: int, xyz: NDArray, rgb: NDArray, images: NDArray, slots: NDArray) -> bytes:
    """One point; its stored error is 0 because observations are exact projections."""
    head = struct.pack("<Q3d3Bd", number, *xyz, *rgb.tolist(), 0.0)
    track = np.stack([images, slots], axis=1).astype("<i4")
    return head + struct.pack("<Q", len(track)) + track.tobytes()
