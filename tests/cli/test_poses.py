"""`abcd poses`: photos alone become a data set, and what cannot is said."""

import os
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image
from rich.console import Console
from scipy.ndimage import gaussian_filter, map_coordinates

from abcd_ns.cli import poses
from abcd_ns.errors import UserError
from tests.data.dataparser_scenes import parser

WIDTH, HEIGHT, FOCAL = 400, 300, 290.0


def corner_of_a_room(place: np.ndarray, textures: np.ndarray) -> Image.Image:
    """A photo of three walls, papered with noise, from `place` towards where they meet, nearly."""
    forward = np.array([0.3, 0.3, 0.3]) - place
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(forward, right), forward])
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
    rays = np.stack([x / FOCAL, y / FOCAL, np.ones_like(x)], axis=-1) @ axes
    with np.errstate(divide="ignore"):
        distance = np.where(rays < 0, -place / rays, np.inf)  # to the walls x = 0, y = 0 and z = 0
    wall = distance.argmin(axis=-1)
    hit = place + rays * distance.min(axis=-1)[..., None]
    u, v = (np.take_along_axis(hit, ((wall + k) % 3)[..., None], axis=-1)[..., 0] for k in (1, 2))
    grid = [np.clip(c * 100, 0, textures.shape[1] - 1.001) for c in (u, v)]
    shades = np.stack([map_coordinates(texture, grid, order=1) for texture in textures])
    grey = np.take_along_axis(shades, wall[None], axis=0)[0]
    return Image.fromarray(np.repeat(grey[..., None], 3, axis=-1).astype(np.uint8))


def write_photos(folder: Path) -> dict[str, np.ndarray]:
    """Write twelve photos; returns where they are taken from, by name."""
    folder.mkdir()
    noise = np.random.default_rng(0).normal(size=(3, 400, 400))
    smooth = sum(gaussian_filter(noise, (0, s, s)) * s for s in (1.5, 4, 10))
    textures = np.clip(128 + 150 * smooth, 0, 255)
    places = {}
    for n, a in enumerate(np.linspace(0.35, 1.25, 12)):
        place = places[f"{n:02d}.png"] = np.array([3 * np.cos(a), 3 * np.sin(a), 1.2 + 0.1 * (n % 3)])
        corner_of_a_room(place, textures).save(folder / f"{n:02d}.png")
    return places


def test_cameras_are_where_they_were(tmp_path, capsys):
    places = write_photos(tmp_path / "images")
    assert poses.poses(tmp_path) == 0
    assert capsys.readouterr().out.count("100%") == 3  # all bars
    model = pycolmap.Reconstruction(str(tmp_path / "sparse" / "0"))
    images = [model.image(i) for i in model.reg_image_ids()]
    assert len(images) == len(places)
    seen = np.array([image.projection_center() for image in images])
    true = np.array([places[image.name] for image in images])
    similarity = pycolmap.estimate_sim3d(seen, true)
    moved = np.array([similarity * center for center in seen])
    assert np.linalg.norm(moved - true, axis=1).max() < 0.03
    (camera,) = model.cameras.values()  # no photo tells its focal length
    assert camera.mean_focal_length() == pytest.approx(FOCAL, rel=0.03)
    outputs = parser(tmp_path).get_dataparser_outputs("train")  # it can be trained on
    assert len(outputs.image_filenames) == 10
    assert len(outputs.metadata["points3D_xyz"]) > 100
    assert sorted(path.name for path in tmp_path.iterdir()) == ["images", "sparse"]
    with pytest.raises(UserError, match="exists already"):
        poses.poses(tmp_path)


@pytest.fixture
def blank(tmp_path) -> Path:
    """Three photos that show nothing."""
    (tmp_path / "images").mkdir()
    for number in range(3):
        Image.new("RGB", (64, 48), (number, 90, 120)).save(tmp_path / "images" / f"{number}.png")
    return tmp_path / "images"


def test_photos_that_show_nothing_are_refused_and_nothing_is_left(blank):
    with pytest.raises(UserError, match="No two photos"):
        poses.poses(blank.parent)
    assert os.listdir(blank.parent) == ["images"]


def of_phones(photo: Path) -> None:
    photo.unlink()
    for name in ("a.HEIC", "b.HEIC", "c.CR2", "notes.txt"):
        photo.with_name(name).touch()


@pytest.mark.parametrize(
    ("spoil", "options", "said"),
    [
        (lambda photo: photo.write_bytes(b"no picture"), {}, r"0\.png is not a picture"),
        (lambda photo: photo.rename(photo.with_name(os.fsdecode(b"\xe9.png"))), {}, "is not UTF-8; rename"),
        (lambda photo: photo.rename(photo.with_suffix(".webp")), {}, r"has 2 photos.* 1 \.webp; make JPEGs"),
        (of_phones, {}, r"has 2 photos.* Not read: 1 \.CR2, 2 \.HEIC; .*jpg \*\.HEIC"),
        (Path.exists, {"lens": "EYE"}, "--lens EYE is none of the camera models"),
    ],
)
def test_what_is_wrong_is_said_before_anything_begins(blank, monkeypatch, spoil, options, said):
    monkeypatch.setattr(poses, "find_poses", None)
    spoil(blank / "0.png")
    with pytest.raises(UserError, match=said):
        poses.poses(blank.parent, **options)
    assert os.listdir(blank.parent) == ["images"]


def test_photos_of_two_sizes_have_two_lenses_and_others_are_told(blank, monkeypatch, capsys):
    (blank / "._0.png").write_bytes(b"what macOS leaves on other systems' disks")
    (blank / "a.HEIC").touch()
    tasks: list[poses.Task] = []
    monkeypatch.setattr(poses, "find_poses", lambda task, _: tasks.append(task))
    for size in ((64, 48), (48, 64)):
        Image.new("RGB", size).save(blank / "9.png")
        with pytest.raises(UserError, match="No two photos"):
            poses.poses(blank.parent)
    assert [(len(task.names), task.one_lens) for task in tasks] == [(4, True), (4, False)]
    said = capsys.readouterr().out
    assert said.count("Photos of 2 sizes") == 1
    assert said.count("Not read: 1 .HEIC") == 2


def test_a_process_that_dies_is_an_error_and_not_a_wait(tmp_path):
    task = poses.Task(tmp_path / "nowhere", ("a.png",), tmp_path, "OPENCV", True, "any")
    with pytest.raises(UserError, match=r"[^.]\.$"):
        poses.find_poses(task, Console(quiet=True))
