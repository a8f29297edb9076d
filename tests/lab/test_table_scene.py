"""The scene of the demo: a COLMAP model whose points have the colours of its pictures."""

import numpy as np
import pycolmap
from PIL import Image

from abcd_ns.lab.world.table_scene import MODEL, draw_table


def test_the_points_that_a_view_gave_have_the_colours_of_its_pixels(tmp_path):
    """Only right if poses, intrinsics, pixel centres and colours all agree with the pictures."""
    draw_table(tmp_path, 8, (48, 36), 800)
    model = pycolmap.Reconstruction(str(tmp_path / MODEL))
    (camera,) = model.cameras.values()
    assert (camera.model.name, camera.width, camera.height) == ("PINHOLE", 48, 36)
    assert (model.num_reg_images(), model.num_points3D()) == (8, 800)
    points = [model.points3D[number] for number in sorted(model.points3D)]
    apart = []
    for k, number in enumerate(sorted(model.images)):
        image = model.images[number]
        pixels = np.asarray(Image.open(tmp_path / "images" / image.name), np.float64)
        for point in points[100 * k : 100 * (k + 1)]:
            column, row = camera.img_from_cam(image.cam_from_world() * point.xyz).astype(int)
            apart.append(np.abs(pixels[row, column] - point.color).mean())
    assert np.median(apart) < 5
    assert np.mean(apart) < 10
