"""The synthetic scene: a valid COLMAP model of pictures that look like a place, the same bytes every time."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from PIL import Image

from abcd_ns.errors import UserError
from abcd_ns.lab.synth import command
from abcd_ns.lab.synth.command import Settings, synth
from abcd_ns.lab.world.court import GRASS
from abcd_ns.lab.world.solids import Thing, block
from abcd_ns.lab.world.sunlight import SunlitWorld

TINY = {"courts": 2, "views_per_court": 4, "width": 48, "height": 36, "points_per_court": 300}
SMALL = {**TINY, "courts": 1, "views_per_court": 3, "points_per_court": 40, "supersample": 1}


def contents(folder: Path) -> dict[str, bytes]:
    """Every file below `folder`."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    out = tmp_path_factory.mktemp("synth") / "two"
    synth(out, Settings(**TINY))
    return out


@pytest.fixture(scope="module")
def model(scene):
    return pycolmap.Reconstruction(str(scene / "sparse" / "0"))


@pytest.fixture
def bare(monkeypatch):
    """Courts are a meadow: quickly drawn, where what is drawn does not matter."""
    meadow = Thing((block((-70, -70, -1), (70, 70, 0), GRASS),))
    monkeypatch.setattr(command, "build_world", lambda site: SunlitWorld([meadow], site.dome, 0))


def test_same_settings_give_same_bytes_whatever_the_threads(tmp_path):
    synth(tmp_path / "one", Settings(**SMALL))
    threads = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        synth(tmp_path / "again", Settings(**SMALL))
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
    assert "abcd synth OUT --courts 2" in (scene / "SOURCE.md").read_text()


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


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_finished_scene_is_left_alone(scene, capsys, overwrite):
    before = {p: p.stat().st_mtime_ns for p in scene.rglob("*")}
    synth(scene, Settings(**TINY), overwrite)
    assert "already holds this scene" in capsys.readouterr().err
    assert {p: p.stat().st_mtime_ns for p in scene.rglob("*")} == before


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_foreign_folder_is_refused(tmp_path, overwrite):
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "holiday.jpg").write_bytes(b"mine")
    with pytest.raises(UserError, match="not empty"):
        synth(tmp_path, Settings(**TINY), overwrite)
    assert contents(tmp_path) == {"images/holiday.jpg": b"mine"}


@pytest.mark.usefixtures("bare")
def test_another_or_an_unfinished_scene_is_replaced_only_on_request(tmp_path):
    def full(*_):
        raise OSError("full")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(command, "write_model", full)
        with pytest.raises(OSError, match="full"):
            synth(tmp_path, Settings(**SMALL))
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(UserError, match="unfinished scene; pass --overwrite"):
        synth(tmp_path, Settings(**SMALL))
    synth(tmp_path, Settings(**SMALL), overwrite=True)
    assert pycolmap.Reconstruction(str(tmp_path / "sparse" / "0")).num_images() == 3
    with pytest.raises(UserError, match="another scene; pass --overwrite"):
        synth(tmp_path, Settings(**{**SMALL, "views_per_court": 2}))
    synth(tmp_path, Settings(**{**SMALL, "views_per_court": 2}), overwrite=True)
    assert len(list((tmp_path / "images").iterdir())) == 2
    assert (tmp_path / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize(("name", "value"), [("courts", 0), ("width", 4), ("seed", -1)])
def test_settings_out_of_range_name_their_flag(tmp_path, name, value):
    with pytest.raises(UserError, match=f"--{name.replace('_', '-')} is {value}"):
        synth(tmp_path / "out", Settings(**{**TINY, name: value}))
    assert not (tmp_path / "out").exists()
