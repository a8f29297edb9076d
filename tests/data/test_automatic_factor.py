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


@pytest.mark.parametrize(("factor", "expected"), [(1, {3300, 900}), (3, {1100, 300})])
def test_a_factor_that_is_given_is_taken_and_nothing_is_said(long_scene, capsys, factor, expected):
    assert widths(long_scene, downscale_factor=factor) == expected
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(("side", "width"), [(320, 3300 // 11), (4000, 3300)])
def test_a_longest_side_that_is_given_is_kept_to_by_a_whole_number(long_scene, capsys, side, width):
    assert max(widths(long_scene, max_side=side)) == width
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
