"""The scene of the demo: a COLMAP model whose points look like its pictures, the same bytes every time."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from PIL import Image

from abcd_ns.lab.world.court_scene import draw_court

SMALL = {"views": 3, "size": (48, 36), "points": 40, "supersample": 1}


def contents(folder: Path) -> dict[str, bytes]:
    """Every file below `folder`."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    out = tmp_path_factory.mktemp("court") / "scene"
    draw_court(out, 8, (48, 36), 600)
    return out


@pytest.fixture(scope="module")
def model(scene):
    return pycolmap.Reconstruction(str(scene / "sparse" / "0"))


def test_the_same_bytes_come_whatever_the_threads(tmp_path):
    draw_court(tmp_path / "one", **SMALL)
    threads = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        draw_court(tmp_path / "again", **SMALL)
    finally:
        torch.set_num_threads(threads)
    assert contents(tmp_path / "again") == contents(tmp_path / "one")


def test_pycolmap_reads_back_what_was_asked_for(scene, model):
    assert model.num_images() == model.num_reg_images() == 8
    (camera,) = model.cameras.values()
    assert (camera.model.name, camera.width, camera.height) == ("PINHOLE", 48, 36)
    assert 400 <= model.num_points3D() <= 600
    names = [model.images[i].name for i in sorted(model.images)]
    assert names == sorted(p.name for p in (scene / "images").iterdir())


def test_tracks_and_observations_agree_and_reproject(model):
    model.update_point_3d_errors()
    assert model.compute_mean_reprojection_error() < 1e-9
    total = 0
    for number, point in model.points3D.items():
        images = [e.image_id for e in point.track.elements]
        assert len(set(images)) == len(images) >= 2
        for element in point.track.elements:
            seen = model.images[element.image_id].points2D[element.point2D_idx]
            assert seen.point3D_id == number
        total += len(images)
    assert total == sum(image.num_points3D for image in model.images.values())


def test_points_have_the_colours_of_their_pixels(scene, model):
    """Only right if poses, intrinsics, pixel centres, visibility and colours all agree with the pictures."""
    near, far = [], []
    rng = np.random.default_rng(0)
    for image in model.images.values():
        pixels = np.asarray(Image.open(scene / "images" / image.name), np.float64)
        for seen in image.points2D:
            color = model.points3D[seen.point3D_id].color
            column, row = (int(v) for v in seen.xy)
            near.append(np.abs(pixels[row, column] - color).mean())
            far.append(np.abs(pixels[rng.integers(36), rng.integers(48)] - color).mean())
    assert np.median(near) < 8
    assert np.mean(near) < 0.4 * np.mean(far)
