"""Photos are reduced to 1600 px where nothing else is said."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from abcd_ns.data.prepare import automatic_factor
from abcd_ns.data.scene import Frame, Lens, Scene
from tests.data.dataparser_scenes import parser, write_capture


@pytest.fixture
def long_scene(tmp_path, monkeypatch) -> Path:
    """Photos of 3300 x 40 px and, every other one, of 900 x 48."""
    monkeypatch.setattr("tests.data.dataparser_scenes.SIZES", ((3300, 40), (900, 48)))
    write_capture(tmp_path)
    return tmp_path


def widths(data: Path, **options) -> set[int]:
    cameras = parser(data, **options).get_dataparser_outputs().cameras
    return set(cameras.width.flatten().tolist())


def test_photos_are_reduced_to_1600_px_by_the_largest_of_them(long_scene, capsys):
    assert widths(long_scene) == {3300 // 4, 900 // 4}
    said = capsys.readouterr().out
    assert said.count("reduced 4 times, to 825 px at most") == 1
    assert "--pipeline.datamanager.dataparser.downscale-factor 1 keeps" in said


@pytest.mark.parametrize(
    ("option", "value", "factor"),
    [("downscale_factor", 1, 1), ("downscale_factor", 3, 3), ("max_side", 320, 11), ("max_side", 4000, 1)],
)
def test_what_is_given_is_kept_to_by_a_whole_number_and_nothing_is_said(
    long_scene, capsys, option, value, factor
):
    assert widths(long_scene, **{option: value}) == {3300 // factor, 900 // factor}
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(("longest", "factor"), [(1600, 1), (1601, 2), (3200, 2), (3201, 4), (6401, 8)])
def test_the_factor_is_nerfstudios(longest, factor):
    sizes, nothing = [(100, 90), (longest, 20)], np.empty((0, 3))
    frames = [Frame("", np.eye(4)[:3], Lens(*size, 1.0, 1.0, 0.0, 0.0)) for size in sizes]
    assert automatic_factor(Scene(Path(), Path(), Path(), frames, nothing, nothing)) == factor


def test_a_scene_with_large_photos_is_viewed_as_it_was_trained(long_scene, capsys):
    trained = parser(long_scene).get_dataparser_outputs().cameras
    shutil.rmtree(long_scene / "images")
    capsys.readouterr()
    viewing = parser(long_scene)
    viewing.downscale_factor = 1  # as FullImageDatamanager does for test_mode="inference"
    viewed = viewing.get_dataparser_outputs().cameras
    assert torch.equal(viewed.width, trained.width)
    assert torch.equal(viewed.fx, trained.fx)
    assert "reduced" not in capsys.readouterr().out
