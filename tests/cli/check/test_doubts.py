"""What `abcd check` finds doubtful: each thing is found where it is, and not where it is not."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from abcd_ns.cli.check.command import examine, summary
from abcd_ns.cli.check.survey import survey
from tests.cli.check.scenes import POINTS, changed, names, the, wide, with_brightness
from tests.data.dataparser_scenes import NAMES, SIZES, write_model, write_photos, write_transforms

# Photos


def test_few_photos_and_a_split_that_leaves_one(tmp_path):
    write_model(tmp_path / "sparse/0", points=POINTS, names=NAMES[:2], params=wide)
    write_photos(tmp_path / "images", names=NAMES[:2])
    (few,) = (finding for finding in examine(tmp_path)[1] if finding.name == "few-photos")
    assert "2 photos, 1 of them to train on" in few.what
    assert "eval-mode all" in few.fix


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
    meta = write_transforms(scene)
    for frame in meta["frames"]:
        frame["mask_path"] = f"masks/{frame['file_path']}"
        (scene / frame["mask_path"]).parent.mkdir(parents=True, exist_ok=True)
        Image.new("L", (frame["w"], frame["h"]), 255).save(scene / frame["mask_path"])
    (scene / "transforms.json").write_text(json.dumps(meta))
    found = survey(scene, 1)
    assert NAMES[0] in the("exif-orientation", found).what
    assert summary(found)["photos"].endswith("10 with a mask, 1 with alpha")


# Cameras and points


def test_focal_lengths_of_other_worlds(found):
    lens = found.prepared.lenses[2]
    lenses = [*found.prepared.lenses]
    lenses[2] = replace(lens, fx=5 * lens.fx, fy=5 * lens.fy)
    odd = replace(found, prepared=replace(found.prepared, lenses=lenses))
    assert found.names[2] in the("unlike-focal-lengths", odd).what


def test_poses_that_are_doubtful(found):
    middle, names = found.centers.mean(axis=0), found.names

    def away(row: int, pose: np.ndarray) -> np.ndarray:
        pose[:, 3] += 1000 * (row == 4)
        return pose

    def in_one_place(_: int, pose: np.ndarray) -> np.ndarray:
        pose[:, 3] = middle + 1e-3 * (pose[:, 3] - middle)
        return pose

    def averted(row: int, pose: np.ndarray) -> np.ndarray:
        if row == 3:
            pose[:, [0, 2]] *= -1
        return pose

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
