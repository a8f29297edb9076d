"""Cameras of transforms.json: each value is used, or refused by name, for a frame or for the file."""

import math
from pathlib import Path

import pytest

from tests.data.dataparser_scenes import SIZES, parser, refusal, save_transforms, write_transforms

RIGHT_ANGLE = math.pi / 2
WHERE = pytest.mark.parametrize("where", ["frame", "file"])


def with_camera(scene: Path, where: str, values: dict, without: tuple[str, ...] = ()) -> Path:
    """The scene with these values of the camera in each frame or beside the frames."""
    meta = write_transforms(scene)
    meta["frames"] = [{k: v for k, v in f.items() if k not in without} for f in meta["frames"]]
    for target in [meta] if where == "file" else meta["frames"]:
        target.update(values)
    save_transforms(scene, meta)
    return scene


def lenses(scene: Path) -> list:
    return [frame.lens for frame in parser(scene).prepared().scene.frames]


@WHERE
@pytest.mark.parametrize(
    ("values", "name", "wanted"),
    [
        ({"camera_model": "OPENCV_FISHEYE"}, "fisheye", True),
        ({"camera_model": "radial_fisheye"}, "fisheye", True),
        ({"is_fisheye": True}, "fisheye", True),
        ({"camera_model": "SIMPLE_RADIAL"}, "fisheye", False),
        ({"distortion_params": [0.1, 0.01, 0, 0, 1e-3, 0]}, "distortion", (0.1, 0.01, 1e-3, 0, 0)),
        ({"k1": 0.1, "k2": 0.01, "p1": 1e-3}, "distortion", (0.1, 0.01, 1e-3, 0, 0)),
    ],
)
def test_the_camera_is_taken_at_either_level(scene, where, values, name, wanted):
    assert {getattr(lens, name) for lens in lenses(with_camera(scene, where, values))} == {wanted}


@WHERE
@pytest.mark.parametrize(
    ("values", "named"),
    [
        *(({"camera_model": name}, name) for name in ("EQUIRECTANGULAR", "VR180_L", "FISHEYE624", "FOV")),
        ({"skew": 0.1}, "skew = 0.1"),
        ({"ftheta_p0": 1.0}, "ftheta_p0"),
        ({"latlong": True}, "latlong"),
        ({"rolling_shutter": [0, 0, 0.01]}, "rolling_shutter"),
        ({"is_fisheye": True, "p1": 0.2, "p2": 0.1}, "p1 = 0.2, p2 = 0.1, which no fisheye has"),
    ],
)
def test_what_is_not_read_is_refused_by_name_in_one_line(scene, where, values, named):
    said = refusal(with_camera(scene, where, values))
    assert named in said
    assert "9 others have the same fault" in said
    assert "\n" not in said


@WHERE
@pytest.mark.parametrize(
    ("values", "focals"),
    [
        ({"fl_y": 50.0}, lambda _: (50.0, 50.0)),
        ({"camera_angle_x": RIGHT_ANGLE}, lambda size: (size[0] / 2, size[0] / 2)),
        (
            {"camera_angle_x": RIGHT_ANGLE, "camera_angle_y": RIGHT_ANGLE},
            lambda size: (size[0] / 2, size[1] / 2),
        ),
        ({"y_fov": 90}, lambda size: (size[1] / 2, size[1] / 2)),
        ({"fl_x": 60.0, "camera_angle_y": RIGHT_ANGLE}, lambda size: (60.0, size[1] / 2)),
    ],
)
def test_focal_lengths_by_pixels_and_by_angles(scene, where, values, focals):
    """The size is the photo's where none is given."""
    found = lenses(with_camera(scene, where, values, without=("fl_x", "fl_y", "w", "h", "cx", "cy")))
    assert {lens.size for lens in found} == set(SIZES)
    for lens in found:
        assert (lens.cx, lens.cy) == (lens.width / 2, lens.height / 2)
        assert (lens.fx, lens.fy) == pytest.approx(focals(lens.size))


def test_a_frame_has_the_last_word_however_it_is_spelled(scene):
    meta = write_transforms(
        scene, camera_model="OPENCV_FISHEYE", distortion_params=[0.3, 0, 0, 0, 0, 0], fl_x=9e3
    )
    for frame in meta["frames"][:4]:
        del frame["fl_x"], frame["fl_y"]
        frame.update(is_fisheye=False, k1=0.1, camera_angle_x=RIGHT_ANGLE)
    save_transforms(scene, meta)
    found = lenses(scene)  # by name, and frames are written in reverse
    assert {(lens.fisheye, lens.distortion[0]) for lens in found[:-4]} == {(True, 0.3)}
    for lens in found[-4:]:
        assert (lens.fisheye, lens.distortion[0], lens.fx) == (False, 0.1, pytest.approx(lens.width / 2))
