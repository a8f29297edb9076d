"""`abcd check`: refuses what training refuses, in its words, and explains what is doubtful."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from abcd_ns.errors import UserError
from abcd_ns.plugin.input_errors import InputError
from abcd_ns.tools.check.command import check, examine, findings_of
from abcd_ns.tools.check.looks import Look
from abcd_ns.tools.check.survey import Survey, survey
from abcd_ns.tools.check.visibility import visibility
from abcd_ns.tools.findings import Finding, by_level
from tests.plugin.dataparser_scenes import (
    NAMES,
    REAL,
    SIZES,
    parser,
    project_pycolmap,
    write_model,
    write_photos,
    write_transforms,
)

POINTS = 600


@pytest.fixture(scope="module")
def sound(tmp_path_factory) -> Path:
    """A scene with nothing doubtful but its two sizes of photos; not to be written to."""
    folder = tmp_path_factory.mktemp("check") / "scene"
    write_model(folder / "sparse/0", points=POINTS)
    write_photos(folder / "images")
    return folder


@pytest.fixture
def scene(sound, tmp_path) -> Path:
    """A copy of it that a test may spoil."""
    return Path(shutil.copytree(sound, tmp_path / "scene"))


@pytest.fixture(scope="module")
def found(sound) -> Survey:
    return survey(sound, 1)


def names(findings: list[Finding] | tuple[Finding, ...]) -> list[str]:
    return [finding.name for finding in findings]


def the(name: str, found: Survey) -> Finding:
    """The one finding of that name."""
    (finding,) = (finding for finding in findings_of(found) if finding.name == name)
    return finding


def changed(found: Survey, pose: Callable | None = None, points: np.ndarray | None = None) -> Survey:
    """The survey of a scene with other poses, `pose(row, 3 x 4)`, or other points."""
    prepared, scene = found.prepared, found.prepared.scene
    if pose is not None:
        moved = [
            replace(frame, camera_to_world=pose(row, frame.camera_to_world.copy()))
            for row, frame in enumerate(scene.frames)
        ]
        prepared = replace(prepared, scene=replace(scene, frames=moved))
    if points is not None:
        prepared = replace(prepared, points_in_model=points)
    # A new object, as centres are kept with the old one.
    return replace(found, prepared=prepared, seen=visibility(prepared))


def with_looks(found: Survey, *looks: Look) -> Survey:
    """The survey with other looks at the first photos."""
    return replace(found, looks=(*looks, *found.looks[len(looks) :]))


# The command


def test_a_sound_scene_is_summed_up(sound, tmp_path, capsys):
    before = sorted(sound.rglob("*"))
    assert check(data=sound, json=tmp_path / "report.json") == 0
    assert sorted(sound.rglob("*")) == before

    printed = capsys.readouterr().out
    report = json.loads((tmp_path / "report.json").read_text())
    summary = report["summary"]
    assert names_in(report) == ["mixed-sizes"]
    assert summary["photos"] == len(NAMES)
    assert summary["sizes"] == {f"{w} x {h}": 5 for w, h in SIZES}
    assert (summary["train"], summary["held_out"], summary["points"]) == (8, 2, POINTS)
    assert summary["photo_bytes"] == sum(5 * 3 * w * h for w, h in SIZES)
    for part in ("10, 5 of", "600", "8 to train on, 2 held out", "mixed-sizes"):
        assert part in printed


def names_in(report: dict) -> list[str]:
    return [finding["name"] for finding in report["findings"]]


def test_near_plane_is_that_of_training(sound, found):
    """Half the depth of the nearest point in a picture that is trained on."""
    depths = []
    for row in found.train:
        pose = found.prepared.scene.frames[row].camera_to_world
        local = (found.points - pose[:, 3]) @ pose[:, :3]
        depths.extend(-local[inside(local, found.prepared.lenses[row]), 2])
    summary = examine(sound).summary
    assert summary.near_plane_model == pytest.approx(min(depths) / 2, rel=0.05)
    assert summary.near_plane == pytest.approx(
        summary.near_plane_model * found.prepared.similarity.scale, rel=1e-6
    )


def inside(local: np.ndarray, lens) -> np.ndarray:
    """Which points, in OpenGL camera coordinates, lie in the picture."""
    u = lens.fx * local[:, 0] / -local[:, 2] + lens.cx
    v = lens.fy * local[:, 1] / local[:, 2] + lens.cy
    return (local[:, 2] < 0) & (u >= 0) & (u < lens.width) & (v >= 0) & (v < lens.height)


def test_points_in_view_are_those_that_pycolmap_projects_into_it(tmp_path):
    model = write_model(tmp_path / "sparse/0", points=300)
    write_photos(tmp_path / "images")
    seen = visibility(parser(tmp_path).prepared())
    for row, name in enumerate(sorted(NAMES)):
        width, height = SIZES[NAMES.index(name) % 2]
        uv = project_pycolmap(model, name)
        expected = ((uv >= 0) & (uv < [width, height])).all(axis=1).sum()
        assert seen.in_view[row] == expected


def test_a_choice_of_many_points_stands_for_all(found, monkeypatch):
    whole = found.seen
    monkeypatch.setattr("abcd_ns.tools.check.visibility.MOST_POINTS", 200)
    part = visibility(found.prepared)
    assert part.in_view == pytest.approx(whole.in_view, abs=0.1 * POINTS)
    assert part.in_view.sum() != whole.in_view.sum()


@pytest.mark.parametrize(
    "spoil",
    [
        lambda scene: shutil.rmtree(scene),
        lambda scene: shutil.rmtree(scene / "images"),
        lambda scene: [(scene / "images" / name).write_bytes(b"") for name in NAMES[:3]],
        lambda scene: (scene / "sparse/0/cameras.bin").write_bytes(b"\xff" * 9),
        lambda scene: (scene / "test_list.txt").write_text("gone.png"),
    ],
    ids=["no scene", "no photos", "empty photos", "damaged model", "split list"],
)
def test_what_training_refuses_is_refused_in_the_same_lines(scene, tmp_path, capsys, spoil):
    spoil(scene)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(InputError) as refused:
        parser(scene).check()

    assert check(data=scene) == 2

    printed = [line.strip() for line in capsys.readouterr().out.splitlines()]
    for line in refused.value.lines:
        assert f"input: {line}" in printed
    assert sorted(tmp_path.rglob("*")) == before


def test_damage_in_the_middle_of_a_photo_is_an_error(scene, capsys):
    """Training would stop when it comes to it: the file ends as it should."""
    path = scene / "images" / NAMES[0]
    data = bytearray(path.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 40] = bytes(40)
    path.write_bytes(data)
    parser(scene).check()

    assert check(data=scene) == 2
    assert f"damaged-photo: {path} cannot be decoded" in capsys.readouterr().out


def test_a_refusal_is_written_too(scene, tmp_path):
    (scene / "images" / NAMES[0]).write_bytes(b"")
    assert check(data=scene, json=tmp_path / "report.json") == 2
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["summary"] is None
    assert [finding["level"] for finding in report["findings"]] == ["error"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"downscale": 0}, "--downscale is 0"),
        ({"json": Path("nowhere/report.json")}, "the folder nowhere does not exist"),
        ({"json": Path("/")}, "is a folder"),
    ],
)
def test_impossible_options_are_refused_before_any_work(options, message):
    with pytest.raises(UserError, match=message):
        check(data=Path("nowhere"), **options)


def test_long_lists_of_errors_are_cut_in_the_terminal_only(tmp_path, capsys):
    many = [f"{i:02d}.png" for i in range(30)]
    write_model(tmp_path / "sparse/0", names=many)
    write_photos(tmp_path / "images", names=many)
    for name in many:
        (tmp_path / "images" / name).unlink()
    assert check(data=tmp_path) == 2
    printed = capsys.readouterr().out
    assert printed.count("cannot be read") == 20
    assert "and 10 more (30 in all)" in printed
    assert len(examine(tmp_path).findings) == 30


def test_findings_are_sorted_by_how_serious_they_are():
    levels = ("note", "error", "warning", "note", "error")
    mixed = [Finding(level, str(i), "") for i, level in enumerate(levels)]
    assert names(by_level(mixed)) == ["1", "4", "2", "0", "3"]


def test_the_readers_notes_are_warnings(tmp_path):
    write_model(tmp_path / "sparse/0", points=0)
    write_photos(tmp_path / "images")
    for i in range(11):
        Image.new("RGB", (9, 9), (i, 90, 90)).save(tmp_path / f"images/extra{i}.png")
    said = [finding.what for finding in examine(tmp_path).findings if finding.name == "input"]
    assert any("has no points" in line for line in said)
    assert any("Fewer than half have one" in line for line in said)


# Photos


def test_few_photos_and_a_split_that_leaves_one(tmp_path):
    write_model(tmp_path / "sparse/0", points=POINTS, names=NAMES[:2])
    write_photos(tmp_path / "images", names=NAMES[:2])
    said = names(examine(tmp_path).findings)
    assert "few-photos" in said
    assert "few-training-views" in said


def test_copies_of_a_photo_are_named_and_leaks_counted(scene):
    ordered = sorted(NAMES)
    assert NAMES.index(ordered[0]) % 2 == NAMES.index(ordered[2]) % 2, "photos of one size"
    shutil.copy(scene / "images" / ordered[0], scene / "images" / ordered[2])
    what = the("duplicate-photos", survey(scene, 1)).what
    assert f"{ordered[0]} = {ordered[2]}" in what
    assert "1 of them are trained on and held out" in what


def test_photos_that_only_look_alike_are_no_copies(scene):
    for name in NAMES[:3:2]:
        Image.new("RGB", SIZES[0], (90, 90, 90)).save(scene / "images" / name)
    Image.new("RGB", SIZES[0], (90, 90, 91)).save(scene / "images" / NAMES[4])
    (group,) = survey(scene, 1).copies
    assert sorted(sorted(NAMES)[row] for row in group) == sorted(NAMES[:3:2])


@pytest.mark.parametrize("kind", ["PNG", "JPEG"])
def test_brightness_is_the_mean_luma(scene, kind):
    noise = np.random.default_rng(0).integers(0, 256, (SIZES[0][1], SIZES[0][0], 3), dtype=np.uint8) // 2
    path = scene / "images" / NAMES[0]
    Image.fromarray(noise).save(path, format=kind)
    found = survey(scene, 1)
    expected = (noise @ [0.299, 0.587, 0.114]).mean() / 255
    assert found.looks[sorted(NAMES).index(NAMES[0])].brightness == pytest.approx(expected, abs=0.01)


def test_exposure_that_varies_is_told_from_blank_photos(found):
    evenly = [Look(0.3 + 0.02 * i) for i in range(len(NAMES))]
    assert not {"exposure", "blank-photos"} & set(names(findings_of(with_looks(found, *evenly))))
    wide = [Look(0.1 + 0.08 * i) for i in range(len(NAMES))]
    assert "factor of" in the("exposure", with_looks(found, *wide)).what
    blank = [Look(0.0), Look(0.999), *evenly[2:]]
    assert "2 photos are black or white" in the("blank-photos", with_looks(found, *blank)).what
    assert "exposure" not in names(findings_of(with_looks(found, *blank)))


def test_orientation_and_alpha_are_noted(scene):
    exif = Image.Exif()
    exif[0x0112] = 3
    Image.new("RGBA", SIZES[0], (9, 90, 90, 120)).save(scene / "images" / NAMES[0], exif=exif)
    found = survey(scene, 1)
    assert NAMES[0] in the("exif-orientation", found).what
    assert the("alpha", found).what.startswith("1 photo has")


def test_masks_are_noted(scene):
    meta = write_transforms(scene)
    for frame in meta["frames"]:
        frame["mask_path"] = f"masks/{frame['file_path']}"
        (scene / frame["mask_path"]).parent.mkdir(parents=True, exist_ok=True)
        Image.new("L", (frame["w"], frame["h"]), 255).save(scene / frame["mask_path"])
    (scene / "transforms.json").write_text(json.dumps(meta))
    assert "10 photos have a mask" in the("masks", survey(scene, 1)).what


def test_photos_beyond_their_share_of_ram(found, monkeypatch):
    monkeypatch.setattr("abcd_ns.tools.check.about_photos.default_budget", lambda: 1000)
    assert "photo-cache-gb" in the("photos-beyond-ram", found).fix


def test_large_photos_come_with_a_factor_that_helps(found):
    source = replace(found.sources[0], stored=(6000, 4000), reduced=(6000, 4000))
    large = replace(found, prepared=replace(found.prepared, sources=[source, *found.sources[1:]]))
    factor = int(the("large-photos", large).fix.split()[-1])
    assert 1e6 < 6000 * 4000 / factor**2 < 4e6


# Cameras


def test_distortion_says_what_becomes_of_the_photos(tmp_path):
    write_model(
        tmp_path / "sparse/0",
        points=POINTS,
        params=lambda w, h: ("OPENCV", [w, w, w / 2, h / 2, -0.1, 0.01, 0, 0]),
    )
    write_photos(tmp_path / "images")
    found = survey(tmp_path, 1)
    before, after = SIZES[0], next(s.size for s in found.sources if s.stored == SIZES[0])
    assert before != after
    what = the("distortion", found).what
    assert f"5 photos, {before[0]} x {before[1]} to {after[0]} x {after[1]}" in what


def test_a_camera_far_from_the_others_is_named(found):
    def away(row: int, pose: np.ndarray) -> np.ndarray:
        pose[:, 3] += 1000 * (row == 4)
        return pose

    assert found.names[4] in the("far-cameras", changed(found, away)).what


def test_cameras_that_only_turned(found):
    middle = found.centers.mean(axis=0)

    def turned(_: int, pose: np.ndarray) -> np.ndarray:
        pose[:, 3] = middle + 1e-3 * (pose[:, 3] - middle)
        return pose

    assert "no depth can be told" in the("one-place", changed(found, turned)).what


def test_focal_lengths_of_other_worlds(found):
    lens = found.prepared.lenses[2]
    lenses = [*found.prepared.lenses]
    lenses[2] = replace(lens, fx=5 * lens.fx, fy=5 * lens.fy)
    odd = replace(found, prepared=replace(found.prepared, lenses=lenses))
    assert found.names[2] in the("unlike-focal-lengths", odd).what


def test_views_without_points_are_named(found):
    def averted(row: int, pose: np.ndarray) -> np.ndarray:
        if row == 3:
            pose[:, [0, 2]] *= -1
        return pose

    what = the("views-without-points", changed(found, averted)).what
    assert what.startswith("1 view shows no point")
    assert found.names[3] in what


def test_points_of_another_model_are_seen_by_no_view(found):
    said = names(findings_of(changed(found, points=found.points + 1e4)))
    assert "no-view-sees-points" in said
    assert "views-without-points" not in said
    assert "unseen-points" not in said


def test_views_with_few_points_come_with_their_number(found):
    sparse = changed(found, points=found.points[:8])
    assert "views-with-few-points" in names(findings_of(sparse))
    assert "8" in the("few-points", sparse).what


# Points


def test_points_far_off_are_counted(found):
    points = found.points.copy()
    points[:2] = [[1e6, 0, 0], [0, 1e6, 0]]
    assert the("far-points", changed(found, points=points)).what.startswith("2 points lie")


def test_points_in_no_picture_are_counted(found):
    back = found.centers.mean(axis=0) - 50 * found.points[:150].mean(axis=0)
    looking = found.prepared.scene.frames[5].camera_to_world[:, 2]
    behind = back + 1000 * looking + found.points[:150]
    what = the("unseen-points", changed(found, points=np.concatenate([found.points, behind]))).what
    assert what.startswith("20% of the points")
    assert "20% behind every camera" in what


def test_geo_referenced_scenes_are_noted(tmp_path):
    write_model(tmp_path / "sparse/0", points=POINTS, offset=5e6)
    write_photos(tmp_path / "images")
    report = examine(tmp_path)
    assert names(report.findings) == ["mixed-sizes", "far-origin"]


# Real scenes


@pytest.mark.parametrize("name", ["fox", "castle-P30"])
def test_real_scenes_are_fine(name):
    if not (REAL / name).is_dir():
        pytest.skip(f"{REAL / name} is not there; set ABCD_DATA to a folder that holds it")
    report = examine(REAL / name)
    assert not [finding for finding in report.findings if finding.level != "note"]
