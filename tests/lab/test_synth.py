"""The synthetic scene: a valid COLMAP model of pictures that look like a place, the same bytes every time."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from PIL import Image

from abcd_ns.errors import UserError
from abcd_ns.lab.synth.command import Settings, synth
from abcd_ns.lab.world.court import GRASS, Site, build_world
from abcd_ns.lab.world.solids import Thing, block
from abcd_ns.lab.world.sunlight import SunlitWorld

TINY = {"courts": 2, "views_per_court": 4, "width": 48, "height": 36, "points_per_court": 300}
SMALL = {**TINY, "courts": 1, "views_per_court": 3, "points_per_court": 40, "supersample": 1}


def contents(folder: Path) -> dict[str, bytes]:
    """Every file below `folder`."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("synth") / "two"
    synth(out, Settings(**TINY))
    return out


@pytest.fixture(scope="module")
def model(scene: Path) -> pycolmap.Reconstruction:
    return pycolmap.Reconstruction(str(scene / "sparse" / "0"))


@pytest.fixture
def bare(monkeypatch: pytest.MonkeyPatch) -> None:
    """Courts are a meadow: quickly drawn, where what is drawn does not matter."""
    meadow = Thing((block((-70, -70, -1), (70, 70, 0), GRASS),))
    monkeypatch.setattr(
        "abcd_ns.lab.synth.command.build_world", lambda site: SunlitWorld([meadow], site.dome, 0)
    )


def picture(scene: Path, name: str) -> np.ndarray:
    return np.asarray(Image.open(scene / "images" / name), np.float64)


def test_same_settings_give_same_bytes_whatever_the_threads(tmp_path: Path) -> None:
    threads = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        synth(tmp_path / "again", Settings(**SMALL))
    finally:
        torch.set_num_threads(threads)
    synth(tmp_path / "one", Settings(**SMALL))
    assert contents(tmp_path / "again") == contents(tmp_path / "one")


def test_pycolmap_reads_back_what_was_asked_for(scene: Path, model: pycolmap.Reconstruction) -> None:
    assert model.num_images() == model.num_reg_images() == 8
    assert model.num_cameras() == 1
    camera = model.cameras[1]
    assert (camera.model.name, camera.width, camera.height) == ("PINHOLE", 48, 36)
    assert 400 <= model.num_points3D() <= 600
    names = [model.images[i].name for i in sorted(model.images)]
    assert names == sorted(p.name for p in (scene / "images").iterdir())
    assert "abcd synth OUT --courts 2" in (scene / "SOURCE.md").read_text()


def test_tracks_and_observations_agree_and_reproject(model: pycolmap.Reconstruction) -> None:
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


def test_points_have_the_colours_of_their_pixels(scene: Path, model: pycolmap.Reconstruction) -> None:
    """Only right if poses, intrinsics, pixel centres, visibility and colours all agree with the pictures."""
    near, far = [], []
    rng = np.random.default_rng(0)
    for image in model.images.values():
        pixels = picture(scene, image.name)
        for seen in image.points2D:
            color = model.points3D[seen.point3D_id].color
            column, row = (int(v) for v in seen.xy)
            near.append(np.abs(pixels[row, column] - color).mean())
            far.append(np.abs(pixels[rng.integers(36), rng.integers(48)] - color).mean())
    assert np.median(near) < 8
    assert np.mean(near) < 0.4 * np.mean(far)


def test_cameras_look_into_their_court_from_above_its_walls_and_upright(
    model: pycolmap.Reconstruction,
) -> None:
    site = Site.plan(2, "grid", 0)
    for image in model.images.values():
        middle = site.center(int(image.name[len("court") :][:3]))
        center, turn = image.projection_center(), image.cam_from_world().rotation.matrix()
        assert np.linalg.norm((center - middle)[:2]) < 12
        assert center[2] > 6.9
        assert turn[1][2] < -0.5
        to_middle = (middle - center) / np.linalg.norm(middle - center)
        assert turn[2] @ to_middle > 0.9


@pytest.mark.parametrize("overwrite", [False, True])
def test_finished_scene_is_left_alone(
    scene: Path, capsys: pytest.CaptureFixture[str], overwrite: bool
) -> None:
    before = {p: p.stat().st_mtime_ns for p in scene.rglob("*")}
    synth(scene, Settings(**TINY), overwrite)
    assert "already holds this scene" in capsys.readouterr().err
    assert {p: p.stat().st_mtime_ns for p in scene.rglob("*")} == before


def test_foreign_folder_is_refused_even_with_overwrite(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "holiday.jpg").write_bytes(b"dear")
    for overwrite in (False, True):
        with pytest.raises(UserError, match="not empty"):
            synth(tmp_path, Settings(**TINY), overwrite)
    assert contents(tmp_path) == {"images/holiday.jpg": b"dear"}


@pytest.mark.usefixtures("bare")
def test_other_scene_is_replaced_only_on_request(tmp_path: Path) -> None:
    synth(tmp_path, Settings(**SMALL))
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(UserError, match="--overwrite"):
        synth(tmp_path, Settings(**{**SMALL, "views_per_court": 2}))
    synth(tmp_path, Settings(**{**SMALL, "views_per_court": 2}), True)
    assert len(list((tmp_path / "images").iterdir())) == 2
    assert (tmp_path / "notes.txt").read_text() == "mine"


@pytest.mark.usefixtures("bare")
def test_interrupted_scene_is_not_taken_for_a_finished_one(tmp_path: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "abcd_ns.lab.synth.command.write_model", lambda *_: (_ for _ in ()).throw(OSError("full"))
        )
        with pytest.raises(OSError, match="full"):
            synth(tmp_path, Settings(**SMALL))
    with pytest.raises(UserError, match="unfinished"):
        synth(tmp_path, Settings(**SMALL))
    synth(tmp_path, Settings(**SMALL), overwrite=True)
    assert pycolmap.Reconstruction(str(tmp_path / "sparse" / "0")).num_images() == 3


@pytest.mark.parametrize(
    ("name", "value"), [("courts", 0), ("width", 4), ("supersample", 0), ("views_per_court", 1), ("seed", -1)]
)
def test_settings_out_of_range_name_their_flag(tmp_path: Path, name: str, value: int) -> None:
    with pytest.raises(UserError, match=f"--{name.replace('_', '-')} is {value}") as caught:
        synth(tmp_path / "out", Settings(**{**TINY, name: value}))
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_gates_can_be_walked_through() -> None:
    """A line through the middle of a shared gate meets nothing before the far court; one above it does."""
    site = Site.plan(2, "row", seed=2)
    world, gate = build_world(site), site.gate(0, 3, True)
    assert site.walls(0)[-1] == (3, True)
    assert len(site.walls(1)) == 3
    start, east = torch.tensor([[-1.2], [-gate], [1.2]]), torch.tensor([[1.0], [0.0], [0.0]])
    assert not bool(world.blocked(start, east, 2.4))
    assert bool(world.blocked(start + torch.tensor([[0.0], [0.0], [1.9]]), east, 2.4))
