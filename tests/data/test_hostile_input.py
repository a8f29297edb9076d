"""Faults rarer than a missing photo: each is one line, found before training, and all at once."""

import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from abcd_ns.data.input_errors import InputError
from abcd_ns.nerfstudio.inspection import inspect
from tests.data.dataparser_scenes import (
    NAMES,
    add_mask,
    parser,
    png_that_claims,
    refusal,
    write_capture,
    write_transforms,
)


def check_refusal(scene: Path, **options) -> list[str]:
    """The lines that `ns-train` would end with before it writes anything."""
    with pytest.raises(InputError) as caught:
        inspect(parser(scene, **options).config)
    return str(caught.value).splitlines()


def test_odd_names_are_read_and_shown_in_one_line(tmp_path):
    names = ["a\nb.png", "c d/[red]\tx.png", "ß/ü 1.png"]
    write_capture(tmp_path, names=names)
    assert parser(tmp_path, eval_mode="all").rows("train") == [0, 1, 2]
    (tmp_path / "images/a\nb.png").unlink()
    assert refusal(tmp_path).splitlines() == [
        f"{tmp_path}/images/a\\nb.png cannot be read (No such file or directory); copy the photo there."
    ]


# COLMAP


def test_names_given_twice_and_missing_photos_are_listed_at_once(tmp_path):
    write_capture(tmp_path, text=True)
    path = tmp_path / "sparse/0/images.txt"
    text = path.read_text()
    path.write_text(text.replace(NAMES[2], NAMES[0]).replace(NAMES[3], NAMES[1]))
    (tmp_path / "images" / NAMES[5]).unlink()
    said = refusal(tmp_path)
    for name in NAMES[:2]:
        assert f"names the photo {name} twice" in said
    assert f"{NAMES[5]} cannot be read" in said
    assert len(said.splitlines()) == 3


def test_points_at_absurd_places_are_left_out(tmp_path, capsys):
    write_capture(tmp_path, text=True)
    with (tmp_path / "sparse/0/points3D.txt").open("a") as file:
        file.write("100 1e300 0 0 9 9 9 0.1\n101 nan 0 0 9 9 9 0.1\n")
    points = parser(tmp_path).get_dataparser_outputs().metadata["points3D_xyz"]
    assert len(points) == 20
    assert points.isfinite().all()
    assert "2 points with NaN, infinity or absurd numbers" in capsys.readouterr().out


def test_path_that_the_system_refuses_is_one_line(tmp_path):
    assert "cannot be read (File name too long)" in refusal(tmp_path / ("x" * 300))


def test_points_that_no_photo_shows_are_refused_in_one_line(scene):
    """Those of another model, or in other coordinates than the frames."""
    write_transforms(scene)
    inspect(parser(scene).config).check_seen()
    path = scene / "points.ply"
    head, _, rows = path.read_text().partition("end_header\n")
    path.write_text(head + "end_header\n" + re.sub(r"(?m)^\S+", "1e4", rows))
    with pytest.raises(InputError, match="None of the 20 points lies in a photo"):
        inspect(parser(scene).config).check_seen()


# Masks


def write_masks(scene: Path) -> list[Path]:
    """A white mask for every frame of a new transforms.json."""
    paths = []
    write_transforms(scene, lambda frame: paths.append(add_mask(scene, frame)))
    return paths


def test_masks_of_no_use_are_all_found_before_training(scene):
    masks = write_masks(scene)
    deep = Image.fromarray(np.full(Image.open(masks[3]).size[::-1], 40_000, np.uint16))
    deep.save(masks[3])  # a mask for all that
    inspect(parser(scene).config)
    Image.new("L", Image.open(masks[0]).size, 0).save(masks[0])
    Image.new("L", (99, 3), 255).save(masks[1])
    masks[2].write_bytes(masks[2].read_bytes()[:60])
    lines = check_refusal(scene)
    faults = ("hides the whole photo", "unlike its photo", "cannot be decoded")
    for path, fault in zip(masks[:3], faults, strict=True):
        assert sum(str(path) in line and fault in line for line in lines) == 1
    assert len(lines) == 3


def test_one_missing_mask_of_all_photos_is_one_line_that_calls_it_a_mask(scene):
    write_transforms(scene, lambda frame: frame.update(mask_path="all.png"))
    (line,) = check_refusal(scene)
    assert line.endswith("all.png cannot be read (No such file or directory); copy the mask there.")
    (scene / "all.png").write_bytes(b"")
    (line,) = check_refusal(scene)
    assert line.endswith("all.png is empty; copy the mask again.")


@pytest.mark.parametrize("size", [(30_000, 20_000), (60_000, 60_000)])
def test_masks_are_measured_before_they_are_decoded(scene, size, monkeypatch):
    """A picture of few bytes may fill all memory; Pillow warns of the first size and refuses the other."""
    mask = write_masks(scene)[0]
    mask.write_bytes(png_that_claims(size, "L"))
    monkeypatch.setattr("abcd_ns.data.photos._decode", None)
    assert check_refusal(scene) == [f"{mask} has more than 500 Mpx; reduce the mask."]


# Split lists


@pytest.mark.parametrize("where", ["test list", "train list", "transforms"])
def test_lists_of_the_data_decide_what_is_held_out(scene, where):
    wanted = sorted(NAMES)[3:5]
    if where == "transforms":
        write_transforms(scene, test_filenames=[f"images/{name}" for name in wanted])
    else:  # what one list leaves is on the other side
        listed = wanted if where == "test list" else set(NAMES) - set(wanted)
        (scene / where.replace(" ", "_")).with_suffix(".txt").write_text("\n".join(listed) + "\n")
    read, interval, everything = (parser(scene, eval_mode=mode) for mode in ("auto", "interval", "all"))
    assert (read.rows("train"), read.rows("test")) == ([0, 1, 2, 5, 6, 7, 8, 9], [3, 4])
    assert interval.rows("test") == [0, 8]
    assert everything.rows("train") == everything.rows("test") == list(range(10))


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
        write_transforms(scene, **lists)
    lines = refusal(scene).splitlines()
    assert len(lines) == 2
    assert "train" in lines[0]
    assert "names a photo without a pose (elsewhere.png)" in lines[0]
    shown = ", ".join(("" if where == "files" else "images/") + name for name in unknown[:3])
    assert f"names 4 photos without a pose ({shown}, ...)" in lines[1]


@pytest.mark.parametrize(("kept", "side"), [(0, "hold out"), (len(NAMES), "train on")])
def test_lists_that_leave_one_side_empty_are_refused(scene, kept, side):
    (scene / "test_list.txt").write_text("\n".join(NAMES[:kept]))
    assert f"nothing to {side}" in refusal(scene)
