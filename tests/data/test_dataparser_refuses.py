"""Scenes that cannot be trained on: each fault is refused with one line that names its file."""

import math
import os
import re
import struct
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from abcd_ns.data.input_errors import SHOWN, InputError, Problems
from abcd_ns.data.picture_files import read_size, read_whole
from tests.data.dataparser_scenes import (
    NAMES,
    SIZES,
    parser,
    png_that_claims,
    refusal,
    save_transforms,
    write_capture,
    write_model,
    write_transforms,
)

MODEL = ("cameras", "images", "points3D")
DEEP = np.full((*SIZES[0][::-1], 3), 40_000, np.uint16)


def test_missing_scene_says_where_to_get_it(tmp_path):
    said = refusal(tmp_path / "garden")
    assert "does not exist" in said
    assert "jonbarron.info/mipnerf360" in said
    assert "sparse/0/cameras.bin" in refusal(tmp_path)


@pytest.mark.parametrize("level", ["scan/images", "scan/sparse", "scan/sparse/0", "scan/images/left", "."])
@pytest.mark.parametrize("kind", ["colmap", "transforms"])
def test_a_folder_above_or_below_the_scene_is_answered_by_the_right_one(tmp_path, level, kind):
    """What the message advises can be read."""
    write_capture(tmp_path / "scan")
    if kind == "transforms":
        write_transforms(tmp_path / "scan")
        (tmp_path / "scan/sparse/0").mkdir(parents=True)
    said = refusal(tmp_path / level)
    (advised,) = re.findall(r"give --data (\S+)\.$", said)
    assert len(said.splitlines()) == 1
    parser(Path(advised)).get_dataparser_outputs()


@pytest.mark.parametrize(
    ("name", "fix"),
    [
        ("walk.MP4", "ffmpeg -i .*walk.MP4 .*walk/images/.*, then `abcd poses .*walk "),
        ("scan.zip", "unpack .*scan.zip"),
        ("a.jpg", "give the folder"),
        ("points.ply", "give the folder"),
    ],
)
def test_a_file_that_is_no_scene_is_answered_by_what_to_do_with_it(tmp_path, name, fix):
    (tmp_path / name).write_bytes(b"x")
    said = refusal(tmp_path / name)
    assert re.search(f"{name} is a file.*{fix}", said)
    assert f"{name}/images" not in said
    if name in ("walk.MP4", "scan.zip"):  # alone in a folder
        assert fix.split()[0] in refusal(tmp_path)


@pytest.mark.parametrize("gone", ["cameras", "images"])
def test_a_model_that_lacks_a_file_is_named_with_it(tmp_path, gone):
    write_capture(tmp_path)
    (tmp_path / f"sparse/0/{gone}.bin").unlink()
    assert f"sparse/0/{gone}.bin cannot be read" in refusal(tmp_path)


@pytest.mark.parametrize(
    ("names", "photos", "message"),
    [
        (["../../secret.png", "b.png"], ["b.png"], "leads out"),
        (["left/0.png", "right/0.png", "1.png"], ["0.png", "1.png"], "twice"),
        (["A.png", "b.png"], ["a.png", "b.png", "a.PNG"], "A.png cannot be read"),
        (["a.png", "b.png"], [], "put the 2 photos"),
    ],
)
def test_names_that_mean_no_photo_or_two_are_refused(tmp_path, names, photos, message):
    write_capture(tmp_path, names, photos)
    assert message in refusal(tmp_path)


@pytest.mark.parametrize("file", [f"{name}.bin" for name in MODEL])
def test_a_binary_model_that_is_cut_or_miscounts_is_refused(scene, file):
    path = scene / "sparse/0" / file
    whole = path.read_bytes()
    for size in (*range(1, len(whole), max(len(whole) // 40, 1)), len(whole) - 1):
        path.write_bytes(whole[:size])
        assert file in refusal(scene)
    path.write_bytes(whole + b"\0")
    assert "more than its entries" in refusal(scene)
    path.write_bytes(b"\xff" * 8 + whole[8:])
    assert "claims" in refusal(scene)
    _fifo(path)
    assert "not a regular file" in refusal(scene)


@pytest.mark.parametrize(("text", "called"), [(False, "number 7"), (True, "FOV")])
def test_unsupported_camera_model_is_named(tmp_path, text, called):
    write_model(tmp_path / "sparse/0", text=text, params=lambda w, h: ("FOV", [w, w, w / 2, h / 2, 0.5]))
    assert re.search(f"has the model {called}.*image_undistorter", refusal(tmp_path))


@pytest.mark.parametrize(
    ("file", "place", "layout", "value", "message"),
    [
        *(("cameras", 8 + 24, "<d", focal, "focal length") for focal in (-50.0, 0.0, 1e9)),
        ("cameras", 8 + 24, "<d", math.nan, "NaN"),
        ("images", 8 + 4, "<d", math.nan, "NaN"),
        # 2^64 - 1 observations of the first of several points: no whole number of a machine holds their size.
        ("points3D", 8 + 8 + 24 + 3 + 8, "<Q", 2**64 - 1, "points3D.bin is cut"),
    ],
)
def test_absurd_values_of_a_binary_model_are_refused(scene, file, place, layout, value, message):
    path = scene / f"sparse/0/{file}.bin"
    data = bytearray(path.read_bytes())
    struct.pack_into(layout, data, place, value)
    path.write_bytes(data)
    assert message in refusal(scene)


def _not_of_colmap(line: str) -> str:
    return line if line.startswith("#") else "1 what"


def _at_the_origin(line: str) -> str:
    words = line.split()
    is_pose = len(words) == 10 and not line.startswith("#")
    return " ".join([words[0], *"1000000", *words[8:]]) if is_pose else line


@pytest.mark.parametrize(
    ("file", "change", "message"),
    [
        *((name, _not_of_colmap, f"{name}.txt, line") for name in MODEL),
        ("images", _at_the_origin, "all cameras at one place"),
        ("images", lambda line: line or None, "an image takes two lines"),
        ("cameras", lambda line: None if line.startswith("2") else line, "uses camera 2"),
    ],
)
def test_bad_lines_of_a_text_model_are_refused(tmp_path, file, change, message):
    write_capture(tmp_path, text=True)
    path = tmp_path / f"sparse/0/{file}.txt"
    lines = map(change, path.read_text().splitlines())
    path.write_text("\n".join(line for line in lines if line is not None) + "\n")
    assert message in refusal(tmp_path)


# Photos


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
        # Pillow would run Ghostscript on it.
        (lambda p: p.write_text("%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n"), "of a known kind"),
        (lambda p: p.write_bytes(cv2.imencode(".tif", DEEP)[1]), "more than 8 bits a channel; convert it to"),
        (lambda p: p.write_bytes(p.read_bytes()[: p.stat().st_size // 2]), "damaged"),
        (_cut_jpeg, "damaged"),
        (_fifo, "not a regular file"),
        (_dangling, "link to nothing"),
        # 16-bit RGB, which Pillow reads but cannot write.
        (lambda p: p.write_bytes(png_that_claims(SIZES[0], depth=16)), "8 bits"),
        (lambda p: Image.fromarray(DEEP[..., 0]).save(p), "8 bits"),
        (lambda p: Image.new("CMYK", SIZES[0]).save(p, format="JPEG"), "CMYK"),
        (lambda p: p.write_bytes(png_that_claims((30_000, 20_000))), "500 Mpx"),
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


def test_photos_that_pillow_takes_for_an_attack_are_read(tmp_path):
    """150 megapixels, as of aerial cameras, and a text of more than a mebibyte."""
    large, long, text = tmp_path / "large.png", tmp_path / "long.png", PngInfo()
    large.write_bytes(png_that_claims((14_204, 10_652)))
    assert read_size(large) == (14_204, 10_652)
    text.add_itxt("XML:com.adobe.xmp", "x" * 2_000_000, zip=True)
    Image.new("RGB", SIZES[0]).save(long, pnginfo=text)
    assert read_size(long) == SIZES[0]
    read_whole(long)


def test_a_tile_of_a_photo_may_have_its_principal_point_in_the_corner(scene):
    meta = write_transforms(scene)
    meta["frames"][0].update(cx=0, cy=0)
    save_transforms(scene, meta)
    assert len(parser(scene).prepared().lenses) == len(NAMES)


def test_long_lists_are_cut_with_a_count():
    problems = Problems()
    for i in range(SHOWN + 2):
        problems.append(f"file\n{i}")
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
        *(({"eval_mode": "fraction", "train_split_fraction": n}, "neither may be 0") for n in (0, 0.95, 1)),
    ],
)
def test_impossible_options_are_refused(scene, options, message):
    assert message in refusal(scene, **options)


# transforms.json


def _spoil(key: str, value) -> Callable[[dict], None]:
    return lambda meta: meta["frames"][3].__setitem__(key, value)


def _spoil_pose(row: int, column: int, value: float) -> Callable[[dict], None]:
    return lambda meta: meta["frames"][3]["transform_matrix"][row].__setitem__(column, value)


def _put_centers_at(x: float) -> Callable[[dict], None]:
    return lambda meta: [frame.update(cx=x, cy=-x) for frame in meta["frames"]]


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_spoil_pose(0, 3, float("nan")), "NaN"),
        (_spoil_pose(0, 0, 3.0), "no rotation"),
        (_spoil_pose(0, 3, 1e30), "1e+30 units from the origin"),
        (_spoil("fl_x", 10**400), "fl_x must be a number"),
        (_spoil("transform_matrix", [[10**400, 0, 0, 0]] * 4), "rows of numbers"),
        (_spoil("file_path", "images/\ud800.png"), "no file can have the name"),
        (_spoil("transform_matrix", (np.diag([1, 1, -1, 1]) + 0.0).tolist()), "mirrors"),
        (_spoil("transform_matrix", [[1, 0], [0, 1]]), "4 x 4"),
        (_spoil("transform_matrix", None), "no transform_matrix; add its pose"),
        (_spoil("fl_x", "500"), 'fl_x must be a number, not "500"'),
        (_spoil("fl_x", None), "fl_x must be a number, not null"),
        (_spoil("fl_x", -500), "focal length"),
        (_spoil("w", 0), "size"),
        (_spoil("is_fisheye", "false"), "must be true or false"),
        *((_put_centers_at(x), "upper left corner") for x in (0, 0.5, -1.5)),
        (_spoil("k4", 0.1), "k4"),
        (_spoil("k1", -40.0), "leaves no picture"),
        (_spoil("file_path", "../../etc/passwd"), "leads out"),
        (_spoil("file_path", "/etc/passwd"), "leads out"),
        (_spoil("mask_path", "../mask.png"), "leads out"),
        (_spoil("file_path", 7), "no file_path"),
        (lambda meta: meta.update(ply_file_path="../cloud.ply"), "leads out"),
        (lambda meta: meta.update(ply_file_path="gone.ply"), "does not exist"),
        (lambda meta: meta.update(frames=[]), "no list of frames"),
        (lambda meta: meta.update(frames=meta["frames"][:1]), "2 are needed"),
        (lambda meta: meta.update(frames=meta["frames"] + meta["frames"][:1]), "twice"),
        (lambda meta: meta.update(applied_scale=0), "positive"),
    ],
)
def test_bad_transforms_json_is_refused(scene, spoil, message):
    meta = write_transforms(scene)
    spoil(meta)
    save_transforms(scene, meta)
    said = refusal(scene)
    assert message in said
    assert len(said.splitlines()) <= 2


@pytest.mark.parametrize(
    "text",
    ['{"frames": [', '{"frames": ' + "[" * 100_000, '{"frames": [{"w": ' + "9" * 5000 + "}]}"],
    ids=["cut", "nested too deep", "too many digits"],
)
def test_file_that_is_no_json_is_refused(scene, text):
    write_transforms(scene)
    (scene / "transforms.json").write_text(text)
    assert "not valid JSON" in refusal(scene)


def test_split_lists_that_do_not_fit_do_not_matter_where_another_split_is_set(scene):
    write_transforms(scene, test_filenames=[])
    assert "set --pipeline.datamanager.dataparser.eval-mode interval" in refusal(scene)
    assert parser(scene, eval_mode="interval").rows("train")


def test_a_model_that_cannot_be_read_does_not_hide_another(scene):
    (scene / "sparse/1").mkdir()
    (scene / "sparse/1/cameras.bin").write_bytes((scene / "sparse/0/cameras.bin").read_bytes())
    (scene / "sparse/1/images.bin").write_bytes(b"")
    assert parser(scene).prepared().scene.model == scene / "sparse/0"
