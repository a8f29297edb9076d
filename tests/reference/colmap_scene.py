"""A tiny COLMAP scene on disk: a wall in two colours, seen by cameras that move along it."""

from pathlib import Path

import numpy as np
import pycolmap
from PIL import Image

WIDTH, HEIGHT, VIEWS = 48, 32, 10
HELD_OUT = 2
"""Rows 0 and 8 of ten."""
LEFT, RIGHT = (40, 80, 200), (200, 60, 40)
FOCAL, DISTANCE = 40.0, 4.0


def write_scene(folder: Path, prefix: str = "") -> Path:
    """Write photos, poses and 300 points on the wall into `folder`, and return it. `prefix` begins names."""
    rng = np.random.default_rng(0)
    model = pycolmap.Reconstruction()
    params = [FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2]
    camera = pycolmap.Camera(camera_id=1, model="PINHOLE", width=WIDTH, height=HEIGHT, params=params)
    model.add_camera_with_trivial_rig(camera)
    (folder / "images").mkdir(parents=True)
    for i in range(VIEWS):
        name, shift = f"{prefix}{i:02d}.png", 0.2 * i - 1
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([-shift, 0.0, DISTANCE]))
        model.add_image_with_trivial_frame(pycolmap.Image(name=name, camera_id=1, image_id=i + 1), pose)
        x = (np.arange(WIDTH) + 0.5 - WIDTH / 2) / FOCAL * DISTANCE + shift
        row = np.where((x > 0)[:, None], RIGHT, LEFT).astype(np.uint8)
        Image.fromarray(np.tile(row, (HEIGHT, 1, 1))).save(folder / "images" / name)
    for xyz in rng.uniform((-3, -2, -0.05), (3, 2, 0.05), (300, 3)):
        color = np.array(RIGHT if xyz[0] > 0 else LEFT, np.uint8)
        model.add_point3D(xyz, pycolmap.Track(), color)
    (folder / "sparse" / "0").mkdir(parents=True)
    model.write_binary(str(folder / "sparse" / "0"))
    return folder
