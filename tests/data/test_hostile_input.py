"""Faults rarer than a missing photo: each is one line, found before training, and all at once."""

import io
import json
import os
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from abcd_ns.data.dataset import AbcdDataset
from abcd_ns.data.input_errors import InputError
from abcd_ns.nerfstudio.inspection import inspect
from tests.data.dataparser_scenes import (
    NAMES,
    SIZES,
    parser,
    refusal,
    write_model,
    write_photos,
    write_transforms,
)


def rewrite(scene: Path, meta: dict) -> None:
    (scene / "transforms.json").write_text(json.dumps(meta))


def png_that_claims(size: tuple[int, int]) -> bytes:
    """A small PNG whose header names a size."""
    file = io.BytesIO()
    Image.new("L", (4, 4), 255).save(file, format="PNG")
    data = bytearray(file.getvalue())
    struct.pack_into(">II", data, 16, *size)
    struct.pack_into(">I", data, 29, zlib.crc32(bytes(data[12:29])))
    return bytes(data)


def check_refusal(scene: Path, **options) -> list[str]:
    """The lines that `ns-train` would end with before it writes anything."""
    with pytest.raises(InputError) as caught:
        inspect(parser(scene, **options).config)
    return str(caught.value).splitlines()


# Photos


def test_tiff_of_16_bits_is_refused(scene, tmp_path):
    deep = np.full((SIZES[0][1], SIZES[0][0], 3), 40_000, np.uint16)
    assert cv2.imwrite(str(tmp_path / "deep.tif"), deep)
    path = scene / "images" / NAMES[0]
    (tmp_path / "deep.tif").replace(path)
    assert refusal(scene) == f"{path} has more than 8 bits a channel; convert it to 8 bits."


def test_formats_that_pillow_gives_to_other_programs_are_refused(scene):
    """An EPS file is a program; Pillow runs Ghostscript on it."""
    path = scene / "images" / NAMES[0]
    path.write_text(f"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 {SIZES[0][0]} {SIZES[0][1]}\n%%EOF\n")
    assert refusal(scene).startswith(f"{path} is not a picture of a known kind")


def test_photo_with_another_ending_is_named(scene):
    path = scene / "images" / NAMES[0]
    path.rename(path.with_suffix(".PNG"))
    assert refusal(scene).endswith("(No such file or directory); 0000.PNG is there: rename it.")


@pytest.mark.parametrize("bad", [21, 30])
def test_the_rest_of_a_long_list_is_counted_once(tmp_path, bad):
    names = [f"{i:02d}.png" for i in range(40)]
    write_model(tmp_path / "sparse/0", names=names)
    write_photos(tmp_path / "images", names=names)
    for name in names[:bad]:
        (tmp_path / "images" / name).write_bytes(b"")
    lines = refusal(tmp_path).splitlines()
    assert len(lines) == 21
    assert lines[-1] == f"... and {bad - 20} more like these ({bad} in all)."


def test_names_with_newlines_are_read_and_shown_in_one_line(tmp_path):
    names = ["a\nb.png", "c\td.png", "e.png"]
    write_model(tmp_path / "sparse/0", names=names)
    write_photos(tmp_path / "images", names=names)
    assert parser(tmp_path, eval_mode="all").rows("train") == [0, 1, 2]
    (tmp_path / "images/a\nb.png").unlink()
    assert refusal(tmp_path).splitlines() == [
        f"{tmp_path}/images/a\\nb.png cannot be read (No such file or directory); copy the photo there."
    ]


# COLMAP


def test_damaged_track_length_is_refused(scene):
    """2^64 - 1 observations of the first of several points: no whole number of a machine holds their size."""
    path = scene / "sparse/0/points3D.bin"
    data = bytearray(path.read_bytes())
    struct.pack_into("<Q", data, 8 + 8 + 24 + 3 + 8, 2**64 - 1)
    path.write_bytes(data)
    assert "points3D.bin is cut" in refusal(scene)


def test_all_broken_files_of_a_model_are_listed_at_once(scene):
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        (scene / "sparse/0" / name).write_bytes(b"")
    assert refusal(scene).splitlines() == [
        f"{scene}/sparse/0/{name} is empty; copy or make it again."
        for name in ("cameras.bin", "images.bin", "points3D.bin")
    ]


def test_names_given_twice_and_missing_photos_are_listed_at_once(tmp_path):
    write_model(tmp_path / "sparse/0", text=True)
    write_photos(tmp_path / "images")
    path = tmp_path / "sparse/0/images.txt"
    text = path.read_text()
    path.write_text(text.replace(NAMES[2], NAMES[0]).replace(NAMES[3], NAMES[1]))
    (tmp_path / "images" / NAMES[5]).unlink()
    said = refusal(tmp_path)
    for name in NAMES[:2]:
        assert f"names the photo {name} twice" in said
    assert f"{NAMES[5]} cannot be read" in said
    assert len(said.splitlines()) == 3


def test_images_txt_without_its_empty_lines_is_refused(tmp_path):
    """Half of the photos would be taken for the 2D points of the others."""
    write_model(tmp_path / "sparse/0", text=True)
    write_photos(tmp_path / "images")
    path = tmp_path / "sparse/0/images.txt"
    lines = path.read_text().splitlines()
    path.write_text("\n".join(line for line in lines if line.strip()))
    assert "an image takes two lines" in refusal(tmp_path)


def test_mixed_camera_models_are_one_scene(tmp_path):
    def params(width: int, height: int) -> tuple[str, list[float]]:
        if (width, height) == SIZES[0]:
            return "OPENCV", [width, width, width / 2, height / 2, 0.05, 0.0, 0.0, 0.0]
        return "PINHOLE", [width, width, width / 2, height / 2]

    write_model(tmp_path / "sparse/0", params=params)
    write_photos(tmp_path / "images")
    flat = {source.stored: source.undistortion for source in parser(tmp_path).prepared().sources}
    assert flat[SIZES[0]] is not None
    assert flat[SIZES[1]] is None


def test_points_at_absurd_places_are_left_out(tmp_path, capsys):
    write_model(tmp_path / "sparse/0", text=True)
    write_photos(tmp_path / "images")
    with (tmp_path / "sparse/0/points3D.txt").open("a") as file:
        file.write("100 1e300 0 0 9 9 9 0.1\n101 nan 0 0 9 9 9 0.1\n")
    points = parser(tmp_path).get_dataparser_outputs().metadata["points3D_xyz"]
    assert len(points) == 20
    assert points.isfinite().all()
    assert "2 points with NaN, infinity or absurd numbers" in capsys.readouterr().out


def test_path_that_the_system_refuses_is_one_line(tmp_path):
    assert "cannot be read (File name too long)" in refusal(tmp_path / ("x" * 300))


# transforms.json


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ('{"frames": ' + "[" * 100_000, "not valid JSON"),
        ('{"frames": [{"w": ' + "9" * 5000 + "}]}", "not valid JSON"),
    ],
    ids=["nested too deep", "too many digits"],
)
def test_json_that_breaks_its_reader_is_refused(scene, value, message):
    write_transforms(scene)
    (scene / "transforms.json").write_text(value)
    assert message in refusal(scene)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("fl_x", 10**400, "fl_x must be a number"),
        ("transform_matrix", [[10**400, 0, 0, 0]] * 4, "rows of numbers"),
        ("file_path", "images/\ud800.png", "no file can have the name"),
    ],
)
def test_absurd_values_are_refused(scene, key, value, message):
    meta = write_transforms(scene)
    meta["frames"][3][key] = value
    rewrite(scene, meta)
    said = refusal(scene)
    assert message in said
    assert len(said.splitlines()) == 1


def test_camera_beyond_all_measure_is_refused(scene):
    meta = write_transforms(scene)
    meta["frames"][3]["transform_matrix"][0][3] = 1e30
    rewrite(scene, meta)
    assert "1e+30 units from the origin" in refusal(scene)


# Masks


def write_masks(scene: Path) -> list[Path]:
    """A white mask for every frame of a new transforms.json."""
    meta = write_transforms(scene)
    paths = []
    for frame in meta["frames"]:
        frame["mask_path"] = frame["file_path"].replace("images", "masks")
        paths.append(scene / frame["mask_path"])
        paths[-1].parent.mkdir(parents=True, exist_ok=True)
        Image.new("L", (frame["w"], frame["h"]), 255).save(paths[-1])
    rewrite(scene, meta)
    return paths


def test_masks_of_no_use_are_all_found_before_training(scene):
    masks = write_masks(scene)
    inspect(parser(scene).config)
    Image.new("L", Image.open(masks[0]).size, 0).save(masks[0])
    Image.new("L", (99, 3), 255).save(masks[1])
    masks[2].write_bytes(masks[2].read_bytes()[:60])
    lines = check_refusal(scene)
    for path, message in zip(
        masks, ("hides the whole photo", "unlike its photo", "cannot be decoded"), strict=False
    ):
        assert sum(str(path) in line and message in line for line in lines) == 1
    assert len(lines) == 3


@pytest.mark.parametrize("size", [(12_000, 9_000), (60_000, 60_000)])
def test_masks_are_measured_before_they_are_decoded(scene, size, monkeypatch):
    """A picture of few bytes may fill all memory; Pillow warns of the first size and refuses the other."""
    mask = write_masks(scene)[0]
    mask.write_bytes(png_that_claims(size))
    decoded = []
    monkeypatch.setattr("abcd_ns.data.photos._decode", lambda path, _: decoded.append(path))
    assert check_refusal(scene) == [f"{mask} has more than 89 Mpx; reduce the mask."]
    assert decoded == []


def test_a_deep_mask_is_a_mask(scene):
    mask = write_masks(scene)[0]
    Image.fromarray(np.full(Image.open(mask).size[::-1], 40_000, np.uint16)).save(mask)
    outputs = parser(scene, eval_mode="all").get_dataparser_outputs()
    assert bool(AbcdDataset(outputs).photos.mask(0).all())


def test_mask_that_is_a_pipe_does_not_block(scene):
    masks = write_masks(scene)
    masks[0].unlink()
    os.mkfifo(masks[0])
    assert "is not a regular file" in refusal(scene)


def test_masks_are_no_photos_without_pose(scene, capsys):
    meta = write_transforms(scene)
    for frame in meta["frames"]:
        frame["mask_path"] = frame["file_path"].replace(".png", "-mask.png")
        Image.new("L", (frame["w"], frame["h"]), 255).save(scene / frame["mask_path"])
    rewrite(scene, meta)
    inspect(parser(scene).config)
    assert "have no pose" not in capsys.readouterr().out


# Split lists


def held_out(scene: Path, **options) -> tuple[list[str], list[str]]:
    """Names of the photos trained on, and of those held out."""
    ready = parser(scene, **options)
    outputs = [ready.get_dataparser_outputs(split).image_filenames for split in ("train", "test")]
    return tuple([path.relative_to(scene / "images").as_posix() for path in paths] for paths in outputs)


@pytest.mark.parametrize("where", ["files", "transforms"])
def test_lists_of_the_data_decide_what_is_held_out(scene, where):
    wanted = sorted(NAMES)[3:5]
    if where == "files":
        (scene / "test_list.txt").write_text("\n".join(wanted) + "\n")
    else:
        rewrite(scene, write_transforms(scene) | {"test_filenames": [f"images/{name}" for name in wanted]})
    train, test = held_out(scene)
    assert test == wanted
    assert train == [name for name in sorted(NAMES) if name not in wanted]
    assert held_out(scene, eval_mode="interval")[1] == sorted(NAMES)[::8]
    assert held_out(scene, eval_mode="all") == (sorted(NAMES), sorted(NAMES))


def test_what_the_train_list_leaves_is_held_out(scene):
    (scene / "train_list.txt").write_text("\n".join(NAMES[:7]))
    train, test = held_out(scene)
    assert (train, test) == (sorted(NAMES[:7]), sorted(NAMES[7:]))


def test_views_in_both_lists_are_mentioned(scene, capsys):
    (scene / "train_list.txt").write_text("\n".join(NAMES[:7]))
    (scene / "val_list.txt").write_text("\n".join(NAMES[6:]))
    inspect(parser(scene).config)
    assert "1 view(s) are trained on and held out" in capsys.readouterr().out


@pytest.mark.parametrize("where", ["files", "transforms"])
def test_lists_that_name_unknown_photos_are_refused(scene, where):
    unknown = ["gone.png", "a.png", "b.png", "c.png"]
    if where == "files":
        (scene / "test_list.txt").write_text("\n".join([NAMES[0], *unknown]))
        (scene / "train_list.txt").write_text("elsewhere.png\n")
    else:
        lists = {"test_filenames": [f"images/{n}" for n in unknown], "train_filenames": ["elsewhere.png"]}
        rewrite(scene, write_transforms(scene) | lists)
    lines = refusal(scene).splitlines()
    assert len(lines) == 2
    assert "train" in lines[0]
    assert "names a photo without a pose (elsewhere.png)" in lines[0]
    shown = ", ".join(("" if where == "files" else "images/") + name for name in unknown[:3])
    assert f"names 4 photos without a pose ({shown}, ...)" in lines[1]


@pytest.mark.parametrize(
    ("kept", "message"), [(0, "nothing to hold out"), (len(NAMES), "nothing to train on")]
)
def test_lists_that_leave_one_side_empty_are_refused(scene, kept, message):
    (scene / "test_list.txt").write_text("\n".join(NAMES[:kept]))
    assert message in refusal(scene)
