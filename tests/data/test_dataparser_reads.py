"""Scenes as users have them: cameras, points and photos are read right."""

import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from abcd_ns.data.prepare import automatic_factor
from abcd_ns.data.scene import Frame, Lens, Scene
from abcd_ns.nerfstudio.dataparser import AbcdDataParserConfig, split_rows
from tests.data.dataparser_scenes import (
    NAMES,
    SIZES,
    parser,
    project,
    project_pycolmap,
    refusal,
    save_transforms,
    write_capture,
    write_photos,
    write_transforms,
)

RIGHT_ANGLE = math.pi / 2
WHERE = pytest.mark.parametrize("where", ["frame", "file"])


@pytest.mark.parametrize("offset", [0.0, 5e6])
@pytest.mark.parametrize("factor", [1, 2])
@pytest.mark.parametrize("text", [False, True])
def test_points_project_where_pycolmap_projects_them(tmp_path, text, factor, offset):
    model = write_capture(tmp_path, text=text, offset=offset)
    outputs = parser(tmp_path, downscale_factor=factor, eval_mode="all").get_dataparser_outputs()
    assert outputs.image_filenames == [tmp_path / "images" / name for name in sorted(NAMES)]
    for row, name in enumerate(sorted(NAMES)):
        width, height = SIZES[NAMES.index(name) % 2]
        size = np.array([width // factor, height // factor])
        expected = project_pycolmap(model, name) * size / [width, height]
        assert np.abs(project(outputs, row) - expected).max() < 1e-2
        assert (outputs.cameras.width[row].item(), outputs.cameras.height[row].item()) == tuple(size)
    assert outputs.metadata["points3D_rgb"].dtype == torch.uint8
    colors = [point.color for _, point in sorted(model.points3D.items())]
    assert np.array_equal(outputs.metadata["points3D_rgb"].numpy(), np.stack(colors))


@pytest.mark.parametrize(
    ("orientation", "center"), [("up", "poses"), ("pca", "focus"), ("vertical", "focus"), ("none", "poses")]
)
def test_geo_referenced_scene_is_the_same_scene(tmp_path, orientation, center):
    outputs = []
    for name, offset in (("near", 0.0), ("far", 5e6)):
        write_capture(tmp_path / name, offset=offset)
        options = {"orientation_method": orientation, "center_method": center}
        outputs.append(parser(tmp_path / name, **options).get_dataparser_outputs())
    near, far = outputs
    assert torch.allclose(near.cameras.camera_to_worlds, far.cameras.camera_to_worlds, atol=1e-6)
    assert torch.allclose(near.metadata["points3D_xyz"], far.metadata["points3D_xyz"], atol=1e-6)
    assert near.dataparser_scale == pytest.approx(far.dataparser_scale, rel=1e-6)


def test_poses_go_back_to_original_coordinates(tmp_path):
    model = write_capture(tmp_path, offset=5e6)
    outputs = parser(tmp_path, eval_mode="all").get_dataparser_outputs()
    back = outputs.transform_poses_to_original_space(outputs.cameras.camera_to_worlds)
    for row, name in enumerate(sorted(NAMES)):
        world = model.find_image_with_name(name).cam_from_world().inverse()
        assert np.abs(back[row, :, 3].numpy() - world.translation).max() < 1e-5
        assert np.abs(back[row, :, :3].numpy() - world.rotation.matrix()).max() < 1e-6
    outputs.save_dataparser_transform(tmp_path / "out.json")
    saved = json.loads((tmp_path / "out.json").read_text())
    xyz = np.stack([point.xyz for _, point in sorted(model.points3D.items())])
    moved = saved["scale"] * (np.array(saved["transform"]) @ np.c_[xyz, np.ones(len(xyz))].T).T
    assert np.abs(moved - outputs.metadata["points3D_xyz"].numpy()).max() < 1e-6


@given(count=st.integers(2, 60), interval=st.integers(2, 12), share=st.floats(0.5, 0.9))
@settings(derandomize=True, max_examples=40, deadline=None)
def test_splits_partition_the_views(count, interval, share):
    def rows(split: str, **options) -> list[int]:
        return split_rows(np.zeros((count, 3)), split, AbcdDataParserConfig(**options))

    everything, by_interval = list(range(count)), {"eval_interval": interval}
    assert rows("test", **by_interval) == rows("val", **by_interval) == everything[::interval]
    assert rows("train", eval_mode="all") == rows("test", eval_mode="all") == everything
    assert sorted(rows("train", **by_interval) + rows("test", **by_interval)) == everything
    if share * count <= count - 1:  # else nothing is held out
        by_share = {"eval_mode": "fraction", "train_split_fraction": share}
        assert sorted(rows("train", **by_share) + rows("test", **by_share)) == everything
        assert len(rows("train", **by_share)) == math.ceil(share * count)


def test_a_sector_is_held_out_at_an_end_of_the_capture():
    angles = np.random.default_rng(0).permutation(np.linspace(0, np.pi, 24))
    centers = np.stack((4 * np.cos(angles), np.sin(angles), np.zeros(24)), axis=1) + 100.0
    config = AbcdDataParserConfig(eval_mode="sector", eval_interval=8)
    train, held_out = (split_rows(centers, split, config) for split in ("train", "val"))
    assert sorted(train + held_out) == list(range(24))
    assert sorted(np.argsort(angles).argsort()[held_out]) in ([0, 1, 2], [21, 22, 23])


def test_zero_distortion_is_a_pinhole(tmp_path):
    write_capture(tmp_path, params=lambda w, h: ("OPENCV", [w, w, w / 2, h / 2, 0.0, 0.0, 0.0, 0.0]))
    outputs = parser(tmp_path).get_dataparser_outputs()
    assert all(source.undistortion is None for source in outputs.metadata["photos"])


def test_reduced_folder_is_used_where_it_fits(scene):
    write_photos(scene / "images_2", divide=2, rounded=lambda x: int(x + 0.5))
    found = parser(scene, downscale_factor=2).prepared()
    for frame, source, lens in zip(found.scene.frames, found.sources, found.lenses, strict=True):
        assert source.path == scene / "images_2" / frame.name
        assert source.size == lens.size == tuple((side + 1) // 2 for side in frame.lens.size)
        assert lens.fx / frame.lens.fx == pytest.approx(lens.width / frame.lens.width)


def test_reduced_folder_that_does_not_fit_is_left_alone(scene, capsys):
    write_photos(scene / "images_2", divide=3)
    outputs = parser(scene, downscale_factor=2).get_dataparser_outputs()
    assert all(path.is_relative_to(scene / "images") for path in outputs.image_filenames)
    assert "does not fit" in capsys.readouterr().out


def test_reduced_copies_serve_where_there_are_no_full_photos(scene):
    shutil.rmtree(scene / "images")
    write_photos(scene / "images_2", divide=2)
    assert parser(scene, downscale_factor=1).get_dataparser_outputs().cameras.width.max() == SIZES[0][0] // 2
    assert parser(scene, downscale_factor=4).get_dataparser_outputs().cameras.width.max() == SIZES[0][0] // 4


# Sizes


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


# transforms.json


@pytest.mark.parametrize("direct", [False, True])
def test_transforms_json_is_the_same_scene(scene, direct):
    colmap = parser(scene, downscale_factor=2).get_dataparser_outputs()
    write_transforms(scene)
    data = scene / "transforms.json" if direct else scene
    nerf = parser(data, downscale_factor=2).get_dataparser_outputs()
    assert nerf.image_filenames == colmap.image_filenames
    assert torch.equal(nerf.metadata["points3D_rgb"], colmap.metadata["points3D_rgb"])
    assert torch.allclose(nerf.metadata["points3D_xyz"], colmap.metadata["points3D_xyz"], atol=1e-6)
    assert torch.allclose(nerf.dataparser_transform, colmap.dataparser_transform)
    for name in ("camera_to_worlds", "fx", "fy", "cx", "cy", "width", "height"):
        assert torch.allclose(getattr(nerf.cameras, name), getattr(colmap.cameras, name), atol=1e-6), name


def test_applied_scale_is_undone_on_the_way_back(scene):
    meta = write_transforms(scene)
    plain = parser(scene).get_dataparser_outputs()
    save_transforms(scene, meta | {"applied_scale": 0.25})
    scaled = parser(scene).get_dataparser_outputs()
    poses = plain.cameras.camera_to_worlds
    assert torch.equal(scaled.cameras.camera_to_worlds, poses)
    back, quarter = (found.transform_poses_to_original_space(poses) for found in (scaled, plain))
    assert torch.allclose(back[..., 3], quarter[..., 3] / 0.25, atol=1e-5)


# Cameras of transforms.json: each value is used, or refused by name, for a frame or for the file


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
