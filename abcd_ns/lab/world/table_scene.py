"""The scene of `abcd demo`: pictures of the table with five balls, and a COLMAP model of their cameras."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from nerfstudio.data.utils import colmap_parsing_utils as colmap
from PIL import Image
from scipy.spatial.transform import Rotation

from abcd_ns.lab.world.world import TABLE, Surfaces, ring
from abcd_ns.progress_bar import tracked

WORLD = Surfaces(tuple(replace(surface, fineness=4.0) for surface in TABLE.surfaces), seed=1, plain=0.9)
MODEL = Path("sparse/0")
LAST = MODEL / "points3D.bin"  # a folder with this file is whole


def draw_table(out: Path, count: int, size: tuple[int, int], points: int) -> None:
    """Draw `count` pictures of `size` (width, height) from around the table into `out`/images, and write the
    model, with about as many `points` on what the cameras see, without observations."""
    views = ring(count, size=size)
    (out / "images").mkdir(parents=True, exist_ok=True)
    images = {}
    nobody = np.zeros(0, np.int64)
    for number, view in enumerate(tracked(views, "Drawing"), 1):
        name = f"view{number:03d}.png"
        Image.fromarray((255 * WORLD.photo(view)).round().byte().numpy()).save(out / "images" / name)
        turn = Rotation.from_matrix(view.viewmat[:3, :3].numpy()).as_quat(canonical=True)
        pose = turn[[3, 0, 1, 2]], view.viewmat[:3, 3].numpy()
        images[number] = colmap.Image(number, *pose, 1, name, np.zeros((0, 2)), nobody)
    found = (each.numpy() for each in WORLD.points(views, points))
    cloud = {
        number: colmap.Point3D(number, place, color.round().astype(np.uint8), 0.0, nobody, nobody)
        for number, (place, color) in enumerate(zip(*found, strict=True), 1)
    }
    (fx, _, cx), (_, fy, cy), _ = views[0].K.tolist()
    camera = colmap.Camera(1, "PINHOLE", *size, (fx, fy, cx, cy))
    (out / MODEL).mkdir(parents=True, exist_ok=True)
    colmap.write_model({1: camera}, images, cloud, out / MODEL)
