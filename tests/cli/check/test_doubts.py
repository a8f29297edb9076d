"""What `abcd check` finds doubtful: each thing is found where it is, and not where it is not."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from abcd_ns.cli.check.command import examine, findings_of
from abcd_ns.cli.check.summary import summarize
from abcd_ns.cli.check.survey import Look, Survey, survey
from tests.cli.check.scenes import POINTS, changed, names, the, wide, with_looks
from tests.data.dataparser_scenes import NAMES, SIZES, write_model, write_photos, write_transforms

# Photos


def test_few_photos_and_a_split_that_leaves_one(tmp_path):
    write_model(tmp_path / "sparse/0", points=POINTS, names=NAMES[:2], params=wide)
    write_photos(tmp_path / "images", names=NAMES[:2])
    (few,) = (finding for finding in examine(tmp_path).findings if finding.name == "few-photos")
    assert "2 photos, 1 of them to train on" in few.what
    assert "eval-mode all" in few.fix


def test_copies_of_a_photo_are_named_and_leaks_counted(scene):
    ordered = sorted(NAMES)
    assert NAMES.index(ordered[0]) % 2 == NAMES.index(ordered[2]) % 2, "photos of one size"
    shutil.copy(scene / "images" / ordered[0], scene / "images" / ordered[2])
    what = the("duplicate-photos", survey(scene, 1)).what
    assert f"{ordered[0]} = {ordered[2]}" in what
    assert "Both trained on and held out: 1." in what


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
    uneven = [Look(0.1 + 0.08 * i) for i in range(len(NAMES))]
    assert "factor of" in the("exposure", with_looks(found, *uneven)).what
    blank = [Look(0.0), Look(0.999), *evenly[2:]]
    assert "2 black or white" in the("blank-photos", with_looks(found, *blank)).what
    assert "exposure" not in names(findings_of(with_looks(found, *blank)))


def test_orientation_alpha_and_masks_are_seen(scene):
    exif = Image.Exif()
    exif[0x0112] = 3
    Image.new("RGBA", SIZES[0], (9, 90, 90, 120)).save(scene / "images" / NAMES[0], exif=exif)
    meta = write_transforms(scene)
    for frame in meta["frames"]:
        frame["mask_path"] = f"masks/{frame['file_path']}"
        (scene / frame["mask_path"]).parent.mkdir(parents=True, exist_ok=True)
        Image.new("L", (frame["w"], frame["h"]), 255).save(scene / frame["mask_path"])
    (scene / "transforms.json").write_text(json.dumps(meta))
    found = survey(scene, 1)
    assert NAMES[0] in the("exif-orientation", found).what
    summary = summarize(found)
    assert (summary["alpha"], summary["masks"]) == (1, 10)


def test_photos_beyond_their_share_of_ram(found, monkeypatch):
    monkeypatch.setattr("abcd_ns.cli.check.rules.default_budget", lambda: 1000)
    assert "photo-cache-gb" in the("photos-beyond-ram", found).fix


# Cameras


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

    assert f"{found.names[3]} (0)" in the("views-with-few-points", changed(found, averted)).what


def behind(found: Survey, count: int) -> np.ndarray:
    """Points behind all cameras, far off."""
    backwards = found.prepared.scene.frames[5].camera_to_world[:, 2]
    return found.centers.mean(axis=0) + 1000 * backwards + found.points[:count]


def test_points_of_another_model_are_seen_by_no_view(found):
    foreign = changed(found, points=behind(found, POINTS))
    assert the("unseen-points", foreign).what.startswith("100% of the points")
    assert "views-with-few-points" not in names(findings_of(foreign))


def test_views_with_few_points_come_with_their_number(found):
    sparse = changed(found, points=found.points[:8])
    assert "views-with-few-points" in names(findings_of(sparse))
    assert "8" in the("few-points", sparse).what


# Points


def test_points_far_off_are_counted(found):
    points = found.points.copy()
    points[:2] = [[1e6, 0, 0], [0, 1e6, 0]]
    assert the("far-points", changed(found, points=points)).what.startswith("2 far")


def test_points_in_no_picture_are_counted(found):
    points = np.concatenate([found.points, behind(found, 150)])
    what = the("unseen-points", changed(found, points=points)).what
    assert what.startswith("20% of the points")
    assert "20% behind every camera" in what
