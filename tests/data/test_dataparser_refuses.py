"""Scenes that cannot be trained on: each fault is refused with one line that names its file."""

import json
import math
import os
import shutil
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from abcd_ns.data.input_errors import SHOWN, InputError, Problems
from tests.data.dataparser_scenes import (
    NAMES,
    REAL,
    SIZES,
    refusal,
    write_model,
    write_photos,
    write_transforms,
)


def test_missing_scene_says_where_to_get_it(tmp_path):
    said = refusal(tmp_path / "garden")
    assert "does not exist" in said
    assert "jonbarron.info/mipnerf360" in said
    assert "sparse/0/cameras.bin" in refusal(tmp_path)


def test_missing_photo_folder_is_one_line(scene):
    shutil.rmtree(scene / "images")
    said = refusal(scene)
    assert "put the 10 photos" in said
    assert "\n" not in said


@pytest.mark.parametrize("file", ["cameras.bin", "images.bin", "points3D.bin"])
@settings(
    derandomize=True,
    max_examples=25,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(share=st.floats(0, 1, exclude_max=True))
def test_cut_model_is_refused(scene, file, share):
    path = scene / "sparse/0" / file
    whole = path.read_bytes()
    try:
        for size in (int(share * len(whole)), len(whole) - 1):
            path.write_bytes(whole[:size])
            assert file in refusal(scene)
        path.write_bytes(whole + b"\0")
        assert "more than its entries" in refusal(scene)
    finally:
        path.write_bytes(whole)


@pytest.mark.parametrize("file", ["cameras.bin", "images.bin", "points3D.bin"])
def test_absurd_counts_are_refused(scene, file):
    path = scene / "sparse/0" / file
    path.write_bytes(b"\xff" * 8 + path.read_bytes()[8:])
    assert "claims" in refusal(scene)
    path.unlink()
    assert file in refusal(scene)
    os.mkfifo(path)
    assert "not a regular file" in refusal(scene)


@pytest.mark.parametrize("file", ["cameras.txt", "images.txt", "points3D.txt"])
def test_broken_text_model_names_the_line(tmp_path, file):
    write_model(tmp_path / "sparse/0", text=True)
    write_photos(tmp_path / "images")
    path = tmp_path / "sparse/0" / file
    lines = path.read_text().splitlines()
    bad = next(i for i, line in enumerate(lines) if line and not line.startswith("#"))
    lines[bad] = "1 what"
    path.write_text("\n".join(lines))
    assert f"{file}, line {bad + 1}" in refusal(tmp_path)


def test_unsupported_camera_model_is_named(tmp_path):
    write_model(tmp_path / "sparse/0", params=lambda w, h: ("FOV", [w, w, w / 2, h / 2, 0.5]))
    assert "image_undistorter" in refusal(tmp_path)
    shutil.rmtree(tmp_path / "sparse")
    write_model(tmp_path / "sparse/0", text=True, params=lambda w, h: ("FOV", [w, w, w / 2, h / 2, 0.5]))
    assert "model FOV" in refusal(tmp_path)


@pytest.mark.parametrize("focal", [-50.0, 0.0, 1e9, float("nan")])
def test_absurd_focal_is_refused(scene, focal):
    path = scene / "sparse/0/cameras.bin"
    data = bytearray(path.read_bytes())
    struct.pack_into("<d", data, 8 + 24, focal)
    path.write_bytes(data)
    assert "camera" in refusal(scene)


def test_pose_with_nan_is_refused(scene):
    path = scene / "sparse/0/images.bin"
    data = bytearray(path.read_bytes())
    struct.pack_into("<d", data, 8 + 4, float("nan"))
    path.write_bytes(data)
    assert "NaN" in refusal(scene)


def test_cameras_at_one_place_are_refused(tmp_path):
    write_model(tmp_path / "sparse/0", text=True)
    write_photos(tmp_path / "images")
    lines = (tmp_path / "sparse/0/images.txt").read_text().splitlines()
    for i, line in enumerate(lines):
        words = line.split()
        if len(words) == 10 and not line.startswith("#"):
            lines[i] = " ".join([words[0], *"1000000", *words[8:]])
    (tmp_path / "sparse/0/images.txt").write_text("\n".join(lines) + "\n")
    assert "all cameras at one place" in refusal(tmp_path)


def test_camera_that_the_model_lacks_is_named(tmp_path):
    write_model(tmp_path / "sparse/0", text=True)
    write_photos(tmp_path / "images")
    path = tmp_path / "sparse/0/cameras.txt"
    path.write_text("\n".join(line for line in path.read_text().splitlines() if not line.startswith("2")))
    assert "uses camera 2" in refusal(tmp_path)


def test_name_that_leaves_the_photo_folder_is_refused(tmp_path):
    write_model(tmp_path / "sparse/0", names=["../../secret.png", "b.png"])
    assert "leads out" in refusal(tmp_path)


# Photos


def _png_16(path: Path) -> None:
    """16-bit RGB, which Pillow reads but cannot write: patch the depth in the header of an 8-bit file."""
    Image.new("RGB", SIZES[0]).save(path)
    data = bytearray(path.read_bytes())
    data[24] = 16
    # The checksum covers the depth.
    struct.pack_into(">I", data, 29, zlib.crc32(bytes(data[12:29])))
    path.write_bytes(data)


def _bomb(path: Path) -> None:
    _png_16(path)
    data = bytearray(path.read_bytes())
    data[24] = 8
    struct.pack_into(">II", data, 16, 12_000, 9_000)
    struct.pack_into(">I", data, 29, zlib.crc32(bytes(data[12:29])))
    path.write_bytes(data)


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def _cut_jpeg(path: Path) -> None:
    Image.open(path).convert("RGB").save(path, format="JPEG")
    path.write_bytes(path.read_bytes()[:-30])


def _fifo(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def _dangling(path: Path) -> None:
    path.unlink()
    path.symlink_to("nowhere.png")


def _turned(path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.new("RGB", SIZES[0][::-1]).save(path, format="JPEG", exif=exif)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda p: p.unlink(), "cannot be read"),
        (lambda p: p.write_bytes(b""), "is empty"),
        (lambda p: p.write_bytes(b"not a picture at all"), "not a picture"),
        (_cut, "damaged"),
        (_cut_jpeg, "damaged"),
        (_fifo, "not a regular file"),
        (_dangling, "link to nothing"),
        (_png_16, "8 bits"),
        (lambda p: Image.fromarray(np.zeros(SIZES[0][::-1], np.uint16)).save(p), "8 bits"),
        (lambda p: Image.new("CMYK", SIZES[0]).save(p, format="JPEG"), "CMYK"),
        (_bomb, "89 Mpx"),
        (lambda p: Image.new("RGB", (SIZES[0][0] + 1, SIZES[0][1])).save(p), "its camera is 61 x 41"),
        (_turned, "EXIF"),
    ],
)
def test_bad_photo_is_named_with_its_fault(scene, spoil, message):
    path = scene / "images" / NAMES[0]
    spoil(path)
    said = refusal(scene)
    assert str(path) in said
    assert message in said
    assert "\n" not in said


def test_all_bad_photos_are_listed_at_once(scene):
    bad = [scene / "images" / name for name in NAMES[:3]]
    for path in bad:
        path.write_bytes(b"")
    said = refusal(scene).splitlines()
    assert sorted(said) == sorted(f"{path} is empty; copy the photo again." for path in bad)


def test_long_lists_are_cut_with_a_count():
    problems = Problems()
    for i in range(SHOWN + 2):
        problems.add(f"file\n{i}")
    with pytest.raises(InputError) as caught:
        problems.raise_if_any()
    last = [f"file\\n{SHOWN - 1}", f"... and 2 more like these ({SHOWN + 2} in all)."]
    assert str(caught.value).splitlines()[SHOWN - 1 :] == last


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"downscale_factor": 0}, "downscale-factor"),
        ({"downscale_factor": 2.5}, "downscale-factor"),
        *(({"scale_factor": value}, "scale-factor is") for value in (0.0, -1.0, math.nan, math.inf)),
        ({"downscale_factor": 50}, "leaves nothing"),
        ({"eval_interval": 1}, "eval-interval"),
    ],
)
def test_impossible_options_are_refused(scene, options, message):
    assert message in refusal(scene, **options)


# transforms.json


def _spoil(key: str, value) -> Callable[[dict], None]:
    return lambda meta: meta["frames"][3].__setitem__(key, value)


def _spoil_pose(row: int, column: int, value: float) -> Callable[[dict], None]:
    return lambda meta: meta["frames"][3]["transform_matrix"][row].__setitem__(column, value)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_spoil_pose(0, 3, float("nan")), "NaN"),
        (_spoil_pose(1, 1, float("inf")), "NaN or infinity"),
        (_spoil_pose(0, 0, 3.0), "no rotation"),
        (_spoil("transform_matrix", (np.diag([1, 1, -1, 1]) + 0.0).tolist()), "mirrors"),
        (_spoil("transform_matrix", [[1, 0], [0, 1]]), "4 x 4"),
        (_spoil("transform_matrix", [[1, 0], [0]]), "matrix"),
        (_spoil("transform_matrix", None), "matrix"),
        (_spoil("fl_x", -500), "focal length"),
        (_spoil("fl_x", "wide"), "must be a number"),
        (_spoil("w", 0), "size"),
        (_spoil("k4", 0.1), "k4"),
        (_spoil("k1", -40.0), "leaves no picture"),
        (_spoil("file_path", "../../etc/passwd"), "leads out"),
        (_spoil("file_path", "/etc/passwd"), "leads out"),
        (_spoil("mask_path", "../mask.png"), "leads out"),
        (_spoil("file_path", 7), "no file_path"),
        (lambda meta: meta.update(ply_file_path="../points.ply"), "leads out"),
        (lambda meta: meta.update(ply_file_path="gone.ply"), "does not exist"),
        (lambda meta: meta.update(camera_model="EQUIRECTANGULAR"), "EQUIRECTANGULAR"),
        (lambda meta: meta.update(frames=[]), "no list of frames"),
        (lambda meta: meta.update(frames=meta["frames"][:1]), "at least 2"),
        (lambda meta: meta.update(frames=meta["frames"] + meta["frames"][:1]), "twice"),
        (lambda meta: meta.update(applied_scale=0), "positive"),
    ],
)
def test_bad_transforms_json_is_refused(scene, spoil, message):
    meta = write_transforms(scene)
    spoil(meta)
    (scene / "transforms.json").write_text(json.dumps(meta))
    said = refusal(scene)
    assert message in said
    assert len(said.splitlines()) <= 2


def test_file_that_is_no_json_is_refused(scene):
    write_transforms(scene)
    (scene / "transforms.json").write_text('{"frames": [')
    assert "not valid JSON" in refusal(scene)


# Real scenes


def test_real_scene_without_photos_is_refused():
    if not (REAL / "garden_geometry").is_dir():
        pytest.skip(f"{REAL / 'garden_geometry'} is not there; set ABCD_DATA to a folder that holds it")
    assert "put the 185 photos" in refusal(REAL / "garden_geometry")
