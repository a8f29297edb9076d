"""The file that is meant: names and places as other systems and programs write them."""

import json
import re
import shutil
import unicodedata
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from abcd_ns.data.normalize import normalizing_similarity
from tests.data import dataparser_scenes
from tests.data.dataparser_scenes import (
    NAMES,
    SIZES,
    add_mask,
    parser,
    refusal,
    save_transforms,
    write_capture,
    write_model,
    write_transforms,
)

WINDOWS = "C:\\Users\\me\\scan\\images\\"


def paths_of(scene: Path, split: str = "all", **options) -> set[str]:
    """Of the photos that are read, from the scene on."""
    mode = "all" if split == "all" else "auto"
    paths = parser(scene, eval_mode=mode, **options).get_dataparser_outputs(split).image_filenames
    return {path.relative_to(scene).as_posix() for path in paths}


IMAGES = {f"images/{name}" for name in NAMES}


@pytest.mark.parametrize(
    "called",
    [
        lambda name: f"images/{name}".replace("/", "\\"),
        lambda name: WINDOWS + name.replace("/", "\\"),
        lambda name: f"/content/data/images/{name}",
        lambda name: f"../scan/images/{name}",
        lambda name: f"IMAGES/{name.upper()}",
        lambda name: f"images/{name}".replace(".png", ".jpg"),
        lambda name: f"./images/{name}".removesuffix(".png"),
    ],
)
def test_transforms_of_other_machines_find_their_photos(scene, called):
    meta = write_transforms(scene)
    wanted = [frame["file_path"] for frame in meta["frames"][:2]]
    for frame in meta["frames"]:
        frame["file_path"] = called(frame["file_path"].removeprefix("images/"))
    meta["test_filenames"] = [frame["file_path"] for frame in meta["frames"][:2]]
    save_transforms(scene, meta)
    assert paths_of(scene) == IMAGES
    assert paths_of(scene, "test") == set(wanted)


OTHERWISE = [
    lambda name: name.replace("/", "\\"),
    lambda name: WINDOWS + name.replace("/", "\\"),
    lambda name: f"images/{name}",
    lambda name: name.upper(),
    lambda name: name.replace(".png", ".jpeg"),
]


@pytest.mark.parametrize("called", OTHERWISE)
def test_models_of_other_machines_find_their_photos(tmp_path, called, capsys):
    write_capture(tmp_path, [called(name) for name in NAMES], NAMES)
    (tmp_path / "test_list.txt").write_text(f"{called(NAMES[0])}\n", encoding="utf-8-sig")
    assert paths_of(tmp_path) == IMAGES
    assert re.search(r"10 files have other names \(.*\)", capsys.readouterr().out)
    assert paths_of(tmp_path, "test") == {f"images/{NAMES[0]}"}


@pytest.mark.parametrize("kind", ["colmap", "transforms"])
@pytest.mark.parametrize("called", OTHERWISE)
def test_lists_of_other_machines_find_their_photos(scene, kind, called):
    if kind == "colmap":
        (scene / "test_list.txt").write_text(f"{called(NAMES[3])}\n")
    else:
        write_transforms(scene, test_filenames=[called(f"images/{NAMES[3]}")])
    assert paths_of(scene, "test") == {f"images/{NAMES[3]}"}


@pytest.mark.parametrize("forms", [("NFC", "NFD"), ("NFD", "NFC")])
def test_the_form_of_unicode_does_not_matter(tmp_path, forms):
    of_model, of_files = ([unicodedata.normalize(form, f"\u00e4{k}.png") for k in range(4)] for form in forms)
    write_capture(tmp_path, of_model, of_files)
    assert paths_of(tmp_path) == {f"images/{name}" for name in of_files}


def put(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"x")


def encode_transforms(scene: Path, encoding: str) -> None:
    (scene / "transforms.json").write_bytes(json.dumps(write_transforms(scene)).encode(encoding))


def put_no_model(scene: Path) -> None:
    """Whatever it is called."""
    write_transforms(scene)
    put(scene / "cameras.txt")
    put(scene / "images.txt")


@pytest.mark.parametrize(
    "change",
    [
        lambda scene: put(scene / "images/left/._0000.png"),
        lambda scene: put(scene / "images/left/@eaDir/0000.png/THUMB_M.jpg"),
        lambda scene: put(scene / "images/left/__MACOSX/0000.png"),
        lambda scene: encode_transforms(scene, "utf-8-sig"),
        lambda scene: encode_transforms(scene, "utf-16"),
        put_no_model,
        lambda scene: write_transforms(scene, lambda each: add_mask(scene, each, "{folder}/{stem}-mask.png")),
        lambda scene: (scene / "images").rename(scene / "Images"),
    ],
)
def test_what_systems_and_other_programs_leave_behind_changes_nothing(scene, change, capsys):
    change(scene)
    assert {path.lower() for path in paths_of(scene)} == IMAGES
    assert "no pose" not in capsys.readouterr().out


def test_text_models_as_windows_saves_them(tmp_path):
    write_capture(tmp_path, text=True)
    for name in ("cameras", "images", "points3D"):
        path = tmp_path / f"sparse/0/{name}.txt"
        path.write_bytes(path.read_text().replace("\n", "\r\n").encode("utf-8-sig"))
    assert paths_of(tmp_path) == IMAGES


# Several models, and models elsewhere


def test_the_model_with_most_photos_is_taken_and_it_is_said(tmp_path, capsys):
    write_capture(tmp_path, NAMES[:3], NAMES)
    write_model(tmp_path / "sparse/1", text=True)
    write_model(tmp_path / "sparse/2", names=NAMES[:4])
    assert paths_of(tmp_path) == IMAGES
    said = capsys.readouterr().out
    assert "sparse/1 is used, with 10 photos" in said
    assert "--pipeline.datamanager.dataparser.colmap-path" in said
    assert len(paths_of(tmp_path, colmap_path=Path("sparse/0"))) == 3


@pytest.mark.parametrize("place", [".", "colmap", "colmap/sparse/0", "sparse"])
def test_a_model_in_any_of_its_places_and_photos_flat_in_a_folder(tmp_path, place):
    write_capture(tmp_path / "made", text=True, names=["a b (1).png", "a b (2).png", "a b (3).png"])
    (tmp_path / "flat" / place).mkdir(parents=True)
    for part in (tmp_path / "made/sparse/0").glob("*.txt"):
        shutil.copy(part, tmp_path / "flat" / place)
    for photo in (tmp_path / "made/images").iterdir():
        shutil.copy(photo, tmp_path / "flat")
    assert paths_of(tmp_path / "flat") == {f"a b ({k}).png" for k in (1, 2, 3)}


def test_where_a_model_lies_is_told(scene):
    shutil.move(scene / "sparse", scene / "dense")
    said = refusal(scene)
    assert "colmap-path dense/0" in said
    assert "abcd poses" not in said
    assert paths_of(scene, colmap_path=Path("dense/0")) == IMAGES
    shutil.move(scene / "images", scene / "photos")
    said = refusal(scene, colmap_path=Path("dense/0"))
    assert "or set --pipeline.datamanager.dataparser.images-path photos" in said


# Points


@pytest.mark.parametrize("text", [True, False])
@pytest.mark.parametrize("cloud", ["none", "empty", "header"])
def test_a_model_without_points_starts_at_random(tmp_path, text, cloud, capsys):
    write_capture(tmp_path, text=text, points=0)
    path = tmp_path / f"sparse/0/points3D.{'txt' if text else 'bin'}"
    if cloud == "none":
        path.unlink()
    elif cloud == "empty":
        path.write_bytes(b"")
    assert "points3D_xyz" not in parser(tmp_path).get_dataparser_outputs().metadata
    assert "has no points" in capsys.readouterr().out


@pytest.mark.parametrize("value", [None, ""])
def test_no_cloud_may_be_named_as_none(scene, value):
    write_transforms(scene, ply_file_path=value)
    assert "points3D_xyz" not in parser(scene).get_dataparser_outputs().metadata


# Sizes


@pytest.mark.parametrize("divide", [2, 0.5, 1.7])
def test_photos_that_are_all_one_share_of_their_cameras_are_taken(tmp_path, divide, capsys):
    write_capture(tmp_path, divide=divide)
    cameras = parser(tmp_path, eval_mode="all").get_dataparser_outputs().cameras
    for row, name in enumerate(sorted(NAMES)):
        width, height = SIZES[NAMES.index(name) % 2]
        assert (cameras.width[row], cameras.height[row]) == (int(width / divide), int(height / divide))
        assert cameras.fx[row].item() == pytest.approx(width * 0.9 * int(width / divide) / width)
    assert "times as large as their cameras" in capsys.readouterr().out


def test_a_photo_may_have_the_size_that_another_photos_camera_says(tmp_path, monkeypatch):
    monkeypatch.setattr(dataparser_scenes, "SIZES", ((40, 30), (80, 60)))
    write_capture(tmp_path, divide=2)
    cameras = parser(tmp_path, eval_mode="all").get_dataparser_outputs().cameras
    assert sorted(set(cameras.width.flatten().tolist())) == [20, 40]


# Surveys


@pytest.mark.parametrize("center", ["poses", "focus", "none"])
@pytest.mark.parametrize("orientation", ["up", "vertical", "pca", "none"])
def test_flights_whose_headings_cancel_have_a_frame(orientation, center):
    poses = np.array([
        np.c_[np.diag([turn, turn, 1.0]), [3.0 * k, 3.0 * line, 10]]
        for line, turn in enumerate((1, -1, 1, -1)) for k in range(4)
    ])  # fmt: skip
    found = normalizing_similarity(poses, orientation, center, True, 1.0)
    assert np.abs(found.rotation @ found.rotation.T - np.eye(3)).max() < 1e-6
    assert np.abs(found.poses(poses)[..., 3]).max() == pytest.approx(1)
    if orientation in ("up", "vertical"):
        assert (found.rotation @ [0, 0, 1])[2] == pytest.approx(1)


def test_cameras_turned_about_their_axes_and_all_ways_have_a_frame():
    turns = Rotation.from_rotvec(np.pi / 2 * np.array([[0, 0, k] for k in range(4)]))
    poses = np.concatenate([turns.as_matrix(), -turns.as_matrix() * [-1, 1, 1]])
    poses = np.concatenate([poses, np.random.default_rng(0).normal(size=(8, 3, 1))], axis=2)
    assert np.isfinite(normalizing_similarity(poses, "up", "focus", True, 1.0).matrix).all()
