"""`abcd check`: refuses what training refuses, in its words, and explains what is doubtful."""

import os
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from abcd_ns.cli.check.command import check, doubts, examine, summary
from abcd_ns.cli.check.survey import Look, Survey, survey, visibility
from abcd_ns.cli.findings import Finding
from abcd_ns.data.input_errors import InputError
from abcd_ns.nerfstudio.inspection import inspect
from tests.data.dataparser_scenes import (
    NAMES,
    SIZES,
    add_mask,
    parser,
    project_pycolmap,
    write_capture,
    write_transforms,
)

POINTS = 600


def wide(width: int, height: int) -> tuple[str, list[float]]:
    """A lens that sees all points from everywhere."""
    return "PINHOLE", [width * 0.3, width * 0.3, width / 2, height / 2]


@pytest.fixture(scope="module")
def sound(tmp_path_factory) -> Path:
    """Nothing about it is doubtful; its photos have two sizes. Not to be written to."""
    folder = tmp_path_factory.mktemp("sound")
    write_capture(folder, points=POINTS, params=wide)
    return folder


@pytest.fixture
def scene(sound, tmp_path) -> Path:
    """A copy that a test may spoil."""
    return Path(shutil.copytree(sound, tmp_path / "scene"))


@pytest.fixture(scope="module")
def found(sound) -> Survey:
    return survey(sound, 1)


def depths_in_training(found: Survey) -> Iterator[float]:
    """Of the points in the pictures that are trained on, in OpenGL camera coordinates."""
    for row in found.train:
        lens, pose = found.prepared.lenses[row], found.prepared.scene.frames[row].camera_to_world
        x, y, z = ((found.points - pose[:, 3]) @ pose[:, :3]).T
        u, v = lens.fx * x / -z + lens.cx, lens.fy * y / z + lens.cy
        yield from -z[(z < 0) & (u >= 0) & (u < lens.width) & (v >= 0) & (v < lens.height)]


def test_a_sound_scene_is_summed_up(sound, found, capsys):
    before = sorted(sound.rglob("*"))
    assert check(data=sound) == 0
    assert sorted(sound.rglob("*")) == before

    printed = capsys.readouterr().out
    assert examine(sound)[1] == []
    assert found.photo_bytes == sum(5 * 3 * w * h for w, h in SIZES)
    # Half the depth of the nearest point in a picture that is trained on.
    near = min(depths_in_training(found)) / 2
    assert found.near == pytest.approx(near * found.prepared.similarity.scale, rel=0.05)
    assert f"is fine: ns-train abcd --data {sound}\n" in printed
    sizes = [f"5 of {w} x {h} px" for w, h in SIZES]
    for part in (f" {len(NAMES)}, ", *sizes, f"{POINTS}, nine tenths", "8 to train on, 2 held out"):
        assert part in printed


def test_points_in_view_are_those_that_pycolmap_projects_into_it(tmp_path):
    model = write_capture(tmp_path, points=300)
    seen = visibility(parser(tmp_path).prepared())
    for row, name in enumerate(sorted(NAMES)):
        width, height = SIZES[NAMES.index(name) % 2]
        uv = project_pycolmap(model, name)
        expected = ((uv >= 0) & (uv < [width, height])).all(axis=1).sum()
        assert seen.in_view[row] == expected


@pytest.mark.parametrize(
    "spoil",
    [
        lambda scene: shutil.rmtree(scene),
        lambda scene: shutil.rmtree(scene / "images"),
        lambda scene: [(scene / "images" / name).write_bytes(b"") for name in NAMES[:3]],
        lambda scene: (scene / "sparse/0/cameras.bin").write_bytes(b"\xff" * 9),
    ],
    ids=["no scene", "no photos", "empty photos", "damaged model"],
)
def test_what_training_refuses_is_refused_in_the_same_lines(scene, tmp_path, capsys, spoil):
    spoil(scene)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(InputError) as refused:
        inspect(parser(scene).config)

    assert check(data=scene) == 2

    printed = [line.strip() for line in capsys.readouterr().out.splitlines()]
    assert [line for line in printed if "input: " in line] == [f"input: {e}" for e in refused.value.lines]
    assert sorted(tmp_path.rglob("*")) == before
    found, findings = examine(scene)
    assert found is None
    assert {finding.level for finding in findings} == {"error"}


def test_damage_in_the_middle_of_a_photo_is_an_error(scene, capsys):
    """Training would stop when it comes to it: the file ends as it should."""
    path = scene / "images" / NAMES[0]
    data = bytearray(path.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 40] = bytes(40)
    path.write_bytes(data)
    inspect(parser(scene).config)

    assert check(data=scene) == 2
    assert f"damaged-photo: {path} cannot be decoded" in capsys.readouterr().out


def test_names_that_no_terminal_takes_are_escaped(scene, capsys):
    written, path = b"right/0000.png", scene / "sparse/0/images.bin"
    odd = b"right/\xff\n00.png"
    path.write_bytes(path.read_bytes().replace(written, odd))
    (scene / "images" / os.fsdecode(written)).unlink()
    Image.new("RGB", SIZES[0]).save(scene / "images" / os.fsdecode(odd))
    assert check(data=scene) == 0
    assert "over: right/\\udcff\\n00.png." in capsys.readouterr().out


def test_the_readers_notes_are_warnings_and_said_once(tmp_path, capsys):
    write_capture(tmp_path, points=0)
    for i in range(11):
        Image.new("RGB", (9, 9), (i, 90, 90)).save(tmp_path / f"images/extra{i}.png")
    said = [finding.what for finding in examine(tmp_path)[1] if finding.name == "input"]
    assert any("has no points" in line for line in said)
    assert any("Fewer than half have one" in line for line in said)
    capsys.readouterr()
    check(data=tmp_path)
    assert " ".join(capsys.readouterr().out.split()).count("Fewer than half have one") == 1


# What is doubtful: it is found where it is, and not where it is not


def names(found: Survey) -> set[str]:
    """Of what is doubtful about it."""
    return {finding.name for finding in doubts(found)}


def the(name: str, found: Survey) -> Finding:
    (finding,) = (finding for finding in doubts(found) if finding.name == name)
    return finding


def changed(found: Survey, poses: np.ndarray | None = None, points: np.ndarray | None = None) -> Survey:
    """The survey of a scene with other poses [n, 3, 4], or other points."""
    prepared, scene = found.prepared, found.prepared.scene
    if poses is not None:
        moved = [replace(f, camera_to_world=pose) for f, pose in zip(scene.frames, poses, strict=True)]
        prepared = replace(prepared, scene=replace(scene, frames=moved))
    if points is not None:
        prepared = replace(prepared, points_in_model=points)
    # A new object, as centres are kept with the old one.
    return replace(found, prepared=prepared, seen=visibility(prepared))


def with_brightness(found: Survey, *brightness: float) -> Survey:
    return replace(found, looks=tuple(map(Look, brightness)))


def test_copies_of_a_photo_are_named_and_leaks_counted(scene):
    ordered = sorted(NAMES)
    assert NAMES.index(ordered[0]) % 2 == NAMES.index(ordered[2]) % 2, "photos of one size"
    shutil.copy(scene / "images" / ordered[0], scene / "images" / ordered[2])
    for name, shade in ((NAMES[0], 90), (NAMES[2], 91)):  # these only look alike
        Image.new("RGB", SIZES[0], (90, 90, shade)).save(scene / "images" / name)
    what = the("duplicate-photos", survey(scene, 1)).what
    assert f"names: {ordered[0]} = {ordered[2]}. Both trained on and held out: 1." in what


@pytest.mark.parametrize("kind", ["PNG", "JPEG"])
def test_brightness_is_the_mean_luma(scene, kind):
    noise = np.random.default_rng(0).integers(0, 256, (SIZES[0][1], SIZES[0][0], 3), dtype=np.uint8) // 2
    path = scene / "images" / NAMES[0]
    Image.fromarray(noise).save(path, format=kind)
    found = survey(scene, 1)
    expected = (noise @ [0.299, 0.587, 0.114]).mean() / 255
    assert found.looks[sorted(NAMES).index(NAMES[0])].brightness == pytest.approx(expected, abs=0.01)


def test_what_is_transparent_is_not_dark(scene):
    picture = Image.new("RGBA", SIZES[0], (0, 0, 0, 0))
    picture.paste((200, 200, 200, 255), (2, 2, 9, 9))
    picture.save(scene / "images" / NAMES[0], format="PNG")
    found = survey(scene, 1).looks[sorted(NAMES).index(NAMES[0])]
    assert found.brightness == pytest.approx(200 / 255, abs=0.01)


def test_exposure_that_varies_is_told_from_blank_photos(found, monkeypatch):
    evenly = [0.3 + 0.02 * i for i in range(len(NAMES))]
    assert not {"exposure", "blank-photos", "photos-beyond-ram"} & names(with_brightness(found, *evenly))
    uneven = with_brightness(found, *(0.1 + 0.08 * i for i in range(len(NAMES))))
    assert "factor of" in the("exposure", uneven).what
    blank = with_brightness(found, 0.0, 0.999, *evenly[2:])
    assert "2 black or white" in the("blank-photos", blank).what
    assert "exposure" not in names(blank)
    monkeypatch.setattr("abcd_ns.cli.check.command.default_budget", lambda: 1000)
    assert "photo-cache-gb" in the("photos-beyond-ram", found).fix


def test_orientation_alpha_and_masks_are_seen(scene):
    exif = Image.Exif()
    exif[0x0112] = 3
    Image.new("RGBA", SIZES[0], (9, 90, 90, 120)).save(scene / "images" / NAMES[0], exif=exif)
    write_transforms(scene, lambda frame: add_mask(scene, frame))
    found = survey(scene, 1)
    assert NAMES[0] in the("exif-orientation", found).what
    assert summary(found)["photos"].endswith("10 with a mask, 1 with alpha")


def test_focal_lengths_of_other_worlds(found):
    lens = found.prepared.lenses[2]
    lenses = [*found.prepared.lenses]
    lenses[2] = replace(lens, fx=5 * lens.fx, fy=5 * lens.fy)
    odd = replace(found, prepared=replace(found.prepared, lenses=lenses))
    assert found.names[2] in the("unlike-focal-lengths", odd).what


def test_poses_that_are_doubtful(found):
    middle, names = found.centers.mean(axis=0), found.names
    away, in_one_place, averted = (
        np.stack([frame.camera_to_world for frame in found.prepared.scene.frames]) for _ in range(3)
    )
    away[4, :, 3] += 1000
    in_one_place[:, :, 3] = middle + 1e-3 * (in_one_place[:, :, 3] - middle)
    averted[3][:, [0, 2]] *= -1
    assert names[4] in the("far-cameras", changed(found, away)).what
    assert "no depth can be told" in the("one-place", changed(found, in_one_place)).what
    assert f"{names[3]} (0)" in the("views-with-few-points", changed(found, averted)).what


def test_points_that_are_doubtful(found):
    backwards = found.prepared.scene.frames[5].camera_to_world[:, 2]
    behind = found.centers.mean(axis=0) + 1000 * backwards + found.points
    foreign = changed(found, points=behind)
    assert the("unseen-points", foreign).what.startswith("100% of the points")
    assert the("unseen-points", foreign).level == "error"
    assert "views-with-few-points" not in names(foreign)
    what = the("unseen-points", changed(found, points=np.concatenate([found.points, behind[:150]]))).what
    assert what.startswith("20% of the points")
    assert "20% behind every camera" in what
    sparse = changed(found, points=found.points[:8])
    assert "views-with-few-points" in names(sparse)
    assert "8" in the("few-points", sparse).what
    far = np.concatenate([[[1e6, 0, 0], [0, 1e6, 0]], found.points[2:]])
    assert the("far-points", changed(found, points=far)).what.startswith("2 far")
