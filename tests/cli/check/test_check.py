"""`abcd check`: refuses what training refuses, in its words, and explains what is doubtful."""

import os
import shutil
from collections.abc import Iterator

import pytest
from PIL import Image

from abcd_ns.cli.check.command import check, examine
from abcd_ns.cli.check.survey import Survey, visibility
from abcd_ns.data.input_errors import InputError
from abcd_ns.nerfstudio.inspection import inspect
from tests.cli.check.scenes import POINTS
from tests.data.dataparser_scenes import (
    NAMES,
    SIZES,
    parser,
    project_pycolmap,
    write_model,
    write_photos,
)


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
    model = write_model(tmp_path / "sparse/0", points=300)
    write_photos(tmp_path / "images")
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


def test_the_readers_notes_are_warnings(tmp_path):
    write_model(tmp_path / "sparse/0", points=0)
    write_photos(tmp_path / "images")
    for i in range(11):
        Image.new("RGB", (9, 9), (i, 90, 90)).save(tmp_path / f"images/extra{i}.png")
    said = [finding.what for finding in examine(tmp_path)[1] if finding.name == "input"]
    assert any("has no points" in line for line in said)
    assert any("Fewer than half have one" in line for line in said)
