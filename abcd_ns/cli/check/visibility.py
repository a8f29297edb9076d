"""Which of the scene's points lie in the pictures of its cameras. Occlusion is not looked at."""

from dataclasses import dataclass

import numpy as np

from abcd_ns.data.prepare import Prepared

MOST_POINTS = 20_000
"""Of more points, an evenly spaced choice is looked at."""


@dataclass(frozen=True)
class Visibility:
    """Counts of points, scaled up where only some were looked at."""

    in_view: np.ndarray
    """float64 [views]: points in each view's picture."""
    in_none: int
    """Points in no picture."""
    behind_all: int
    """Those of them that lie behind every camera."""
    depth: np.ndarray
    """float64 [views]: median distance of the points in the picture along its axis, model units; NaN without
    any."""


def visibility(prepared: Prepared) -> Visibility:
    """Project the points into every final camera, in float64."""
    scene, points = prepared.scene, prepared.points_in_model
    step = -(-len(points) // MOST_POINTS) or 1
    factor, points = len(points) / max(len(points[::step]), 1), points[::step]
    ever_in, ever_ahead = np.zeros(len(points), bool), np.zeros(len(points), bool)
    in_view, depth = np.zeros(len(scene.frames)), np.full(len(scene.frames), np.nan)
    for row, (frame, lens) in enumerate(zip(scene.frames, prepared.lenses, strict=True)):
        pose = frame.camera_to_world
        # OpenGL cameras look along -z, with y upwards; pictures count rows downwards.
        x, y, z = ((points - pose[:, 3]) @ (pose[:, :3] * [1, -1, -1])).T
        ahead = z > 0
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            u, v = lens.fx * x / z + lens.cx, lens.fy * y / z + lens.cy
        inside = ahead & (u >= 0) & (u < lens.width) & (v >= 0) & (v < lens.height)
        ever_in |= inside
        ever_ahead |= ahead
        in_view[row] = factor * inside.sum()
        if inside.any():
            depth[row] = np.median(z[inside])
    return Visibility(in_view, round(factor * (~ever_in).sum()), round(factor * (~ever_ahead).sum()), depth)
