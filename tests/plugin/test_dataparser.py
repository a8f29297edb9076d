"""Scenes as users have them: what is read right, and what is refused with one line a file."""

import json
import os
import shutil
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from abcd_ns.plugin.data.colmap_model import Z_UP, read_colmap
from abcd_ns.plugin.data.dataset import AbcdDataset
from abcd_ns.plugin.data.ply import read_points
from abcd_ns.plugin.dataparser import AbcdDataParser, AbcdDataParserConfig, split_rows
from abcd_ns.plugin.input_errors import InputError, Problems

REAL = Path(os.environ.get("ABCD_DATA", Path(__file__).resolve().parents[2].parent / "shared" / "data"))
SIZES = ((61, 41), (47, 33))
"""Of the two cameras; odd, so that halving rounds down."""
NAMES = [f"{'left' if i % 2 else 'right'}/{i // 2:04d}.png" for i in range(10)]


def write_model(
    folder: Path,
    *,
    text: bool = False,
    offset: float = 0.0,
    points: int = 20,
    params: Callable[[int, int], tuple[str, list[float]]] | None = None,
    names: list[str] = NAMES,
) -> pycolmap.Reconstruction:
    """Cameras on an arc that look at points around `offset`, through pycolmap; two camera sizes in turn."""
    rng = np.random.default_rng(0)
    params = params or (lambda w, h: ("PINHOLE", [w * 0.9, w * 0.95, w / 2 + 1, h / 2 - 2]))
    model = pycolmap.Reconstruction()
    for number, (width, height) in enumerate(SIZES, start=1):
        kind, values = params(width, height)
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(camera_id=number, model=kind, width=width, height=height, params=values)
        )
    for i, name in enumerate(names):
        angle = 0.9 * i / len(names) - 0.4
        rotation = pycolmap.Rotation3d(np.array([0.02 * i, angle, 0.01]))
        center = np.array([4 * np.sin(angle), 0.1 * i, -4 * np.cos(angle)]) + offset
        pose = pycolmap.Rigid3d(rotation.inverse(), -(rotation.inverse() * center))
        image = pycolmap.Image(name=name, camera_id=1 + i % 2, image_id=len(names) - i)
        model.add_image_with_trivial_frame(image, pose)
    for xyz in rng.uniform(-1, 1, (points, 3)):
        model.add_point3D(xyz + offset, pycolmap.Track(), rng.integers(0, 256, 3).astype(np.uint8))
    folder.mkdir(parents=True)
    (model.write_text if text else model.write_binary)(str(folder))
    return model


def write_photos(folder: Path, names: list[str] = NAMES, divide: float = 1, rounded: Callable = int) -> None:
    """Noise photos of the cameras' sizes, divided and rounded."""
    rng = np.random.default_rng(1)
    for i, name in enumerate(names):
        width, height = (rounded(side / divide) for side in SIZES[i % 2])
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(rng.integers(0, 256, (height, width, 3), dtype=np.uint8)).save(folder / name)


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A small sound scene, COLMAP binary."""
    write_model(tmp_path / "scene/sparse/0")
    write_photos(tmp_path / "scene/images")
    return tmp_path / "scene"


def parser(data: Path, **options) -> AbcdDataParser:
    return AbcdDataParserConfig(data=data, **options).setup()


def project(outputs, index: int) -> np.ndarray:
    """Pixels float64 [n, 2] of the outputs' own points in one of its cameras, written out."""
    camera = outputs.cameras[index]
    pose = camera.camera_to_worlds.double().numpy() * [1, -1, -1, 1]
    local = (outputs.metadata["points3D_xyz"].double().numpy() - pose[:, 3]) @ pose[:, :3]
    fx, fy, cx, cy = (getattr(camera, name).item() for name in ("fx", "fy", "cx", "cy"))
    return local[:, :2] / local[:, 2:] * [fx, fy] + [cx, cy]


def project_pycolmap(model: pycolmap.Reconstruction, name: str) -> np.ndarray:
    image = model.find_image_with_name(name)
    return np.stack([image.project_point(point.xyz) for _, point in sorted(model.points3D.items())])


def refusal(data: Path, **options) -> str:
    """The message that a scene is refused with."""
    with pytest.raises(InputError) as caught:
        parser(data, **options).get_dataparser_outputs()
    return str(caught.value)


# What is read


@pytest.mark.parametrize("offset", [0.0, 5e6])
@pytest.mark.parametrize("factor", [1, 2])
@pytest.mark.parametrize("text", [False, True])
def test_points_project_where_pycolmap_projects_them(tmp_path, text, factor, offset):
    model = write_model(tmp_path / "sparse/0", text=text, offset=offset)
    write_photos(tmp_path / "images")
    outputs = parser(tmp_path, downscale_factor=factor, eval_mode="all").get_dataparser_outputs()
    assert [path.relative_to(tmp_path / "images").as_posix() for path in outputs.image_filenames] == sorted(
        NAMES
    )
    for row, name in enumerate(sorted(NAMES)):
        width, height = SIZES[NAMES.index(name) % 2]
        size = np.array([width // factor, height // factor])
        expected = project_pycolmap(model, name) * size / [width, height]
        assert np.abs(project(outputs, row) - expected).max() < 1e-2
        assert (outputs.cameras.width[row].item(), outputs.cameras.height[row].item()) == tuple(size)
    assert outputs.metadata["points3D_rgb"].dtype == torch.uint8
    colors = [point.color for _, point in sorted(model.points3D.items())]
    assert np.array_equal(outputs.metadata["points3D_rgb"].numpy(), np.stack(colors))


@pytest.mark.parametrize("center", ["poses", "focus"])
@pytest.mark.parametrize("orientation", ["up", "pca", "vertical", "none"])
def test_geo_referenced_scene_is_the_same_scene(tmp_path, orientation, center):
    outputs = []
    for name, offset in (("near", 0.0), ("far", 5e6)):
        write_model(tmp_path / name / "sparse/0", offset=offset)
        write_photos(tmp_path / name / "images")
        options = {"orientation_method": orientation, "center_method": center}
        outputs.append(parser(tmp_path / name, **options).get_dataparser_outputs())
    near, far = outputs
    assert torch.allclose(near.cameras.camera_to_worlds, far.cameras.camera_to_worlds, atol=1e-6)
    assert torch.allclose(near.metadata["points3D_xyz"], far.metadata["points3D_xyz"], atol=1e-6)
    assert near.dataparser_scale == pytest.approx(far.dataparser_scale, rel=1e-6)


def test_poses_go_back_to_original_coordinates(tmp_path):
    model = write_model(tmp_path / "sparse/0", offset=5e6)
    write_photos(tmp_path / "images")
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


def test_default_frame_is_nerfstudios(scene):
    """Against nerfstudio's own COLMAP parser, which works in float32."""
    from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig

    theirs = ColmapDataParserConfig(
        data=scene, colmap_path=Path("sparse/0"), downscale_factor=1, eval_mode="all"
    )
    theirs = theirs.setup().get_dataparser_outputs()
    ours = parser(scene, eval_mode="all").get_dataparser_outputs()
    order = [theirs.image_filenames.index(path) for path in ours.image_filenames]
    assert torch.allclose(ours.cameras.camera_to_worlds, theirs.cameras.camera_to_worlds[order], atol=1e-5)
    assert torch.allclose(ours.dataparser_transform.float(), theirs.dataparser_transform, atol=1e-5)
    assert ours.dataparser_scale == pytest.approx(theirs.dataparser_scale, rel=1e-5)


def test_held_out_views_are_every_eighth_by_name(scene):
    train, test = (parser(scene).get_dataparser_outputs(split).image_filenames for split in ("train", "test"))
    ordered = [scene / "images" / name for name in sorted(NAMES)]
    assert test == ordered[::8]
    assert sorted(train + test) == ordered


@given(count=st.integers(2, 60), interval=st.integers(2, 12))
@settings(derandomize=True, max_examples=40, deadline=None)
def test_splits_partition_the_views(count, interval):
    config = AbcdDataParserConfig(eval_interval=interval)
    train, test, val = (split_rows(count, split, config) for split in ("train", "test", "val"))
    assert test == val == list(range(0, count, interval))
    assert sorted(train + test) == list(range(count))
    everything = AbcdDataParserConfig(eval_mode="all")
    assert (
        split_rows(count, "train", everything) == split_rows(count, "test", everything) == list(range(count))
    )


@pytest.mark.parametrize("folder", ["sparse/0", "colmap/sparse/0", "sparse"])
def test_model_is_found_without_a_flag(tmp_path, folder):
    write_model(tmp_path / folder)
    write_photos(tmp_path / "images")
    assert len(parser(tmp_path).get_dataparser_outputs().image_filenames) == 8


def test_dataset_gives_photos_of_the_cameras_sizes_and_writes_nothing(scene):
    before = sorted(scene.rglob("*"))
    outputs = parser(scene, downscale_factor=2).get_dataparser_outputs()
    dataset = AbcdDataset(outputs)
    for i in range(len(dataset)):
        data = dataset.get_data(i, image_type="uint8")
        camera = dataset.cameras[i]
        assert data["image"].shape == (camera.height.item(), camera.width.item(), 3)
        assert torch.equal(dataset[i]["image"], data["image"].float() / 255)
    assert sorted(scene.rglob("*")) == before
    with pytest.raises(InputError, match="downscale-factor"):
        AbcdDataset(outputs, scale_factor=0.5)


def test_photo_of_a_pinhole_is_bit_equal(scene):
    outputs = parser(scene).get_dataparser_outputs()
    for i, path in enumerate(outputs.image_filenames):
        assert np.array_equal(AbcdDataset(outputs).get_numpy_image(i), np.array(Image.open(path)))


@pytest.mark.parametrize(("kind", "extra"), [("SIMPLE_RADIAL", [0.0]), ("OPENCV", [0.0, 0.0, 0.0, 0.0])])
def test_zero_distortion_is_a_pinhole(tmp_path, scene, kind, extra):
    def params(w, h):
        focal = [w * 0.9] if kind == "SIMPLE_RADIAL" else [w * 0.9, w * 0.9]
        return kind, [*focal, w / 2, h / 2, *extra]

    write_model(tmp_path / "zero/sparse/0", params=params)
    shutil.copytree(scene / "images", tmp_path / "zero/images")
    outputs = parser(tmp_path / "zero").get_dataparser_outputs()
    assert all(source.undistortion is None for source in outputs.metadata["photos"])


def test_distorted_cameras_become_pinholes(tmp_path):
    write_model(
        tmp_path / "sparse/0", params=lambda w, h: ("OPENCV", [w, w, w / 2, h / 2, 0.1, 0.01, 1e-3, 2e-3])
    )
    write_photos(tmp_path / "images")
    outputs = parser(tmp_path).get_dataparser_outputs()
    assert outputs.cameras.distortion_params is None
    for i, source in enumerate(outputs.metadata["photos"]):
        assert source.size == (outputs.cameras.width[i].item(), outputs.cameras.height[i].item())
        assert AbcdDataset(outputs).get_numpy_image(i).shape == (*source.size[::-1], 3)


def test_reduced_folder_is_used_where_it_fits(scene):
    write_photos(scene / "images_2", divide=2, rounded=lambda x: int(x + 0.5))
    outputs = parser(scene, downscale_factor=2).get_dataparser_outputs()
    assert all(path.is_relative_to(scene / "images_2") for path in outputs.image_filenames)
    first = outputs.metadata["photos"][0]
    full = SIZES[NAMES.index(first.path.relative_to(scene / "images_2").as_posix()) % 2]
    assert first.size == ((full[0] + 1) // 2, (full[1] + 1) // 2)
    ratio = outputs.cameras.fx[0].item() / (full[0] * 0.9)
    assert ratio == pytest.approx(first.size[0] / full[0], rel=1e-6)


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


def test_scene_is_viewed_without_photos(scene):
    shutil.rmtree(scene / "images")
    viewing = parser(scene, downscale_factor=2)
    viewing.downscale_factor = 1  # as FullImageDatamanager does for test_mode="inference"
    assert viewing.get_dataparser_outputs().cameras.width.max() == SIZES[0][0] // 2


def test_scene_without_points_starts_at_random(tmp_path, capsys):
    write_model(tmp_path / "sparse/0", points=0)
    write_photos(tmp_path / "images")
    assert "points3D_xyz" not in parser(tmp_path).get_dataparser_outputs().metadata
    assert "no points" in capsys.readouterr().out


def test_photos_without_pose_are_mentioned(scene, capsys):
    Image.new("RGB", (9, 9)).save(scene / "images/extra.png")
    parser(scene).get_dataparser_outputs()
    assert "1 photos in" in capsys.readouterr().out


def test_odd_file_names(tmp_path):
    names = ["a b/ü 1.png", "a b/[red]x.png", "ß/ü 1.png"]
    write_model(tmp_path / "sparse/0", names=names)
    write_photos(tmp_path / "images", names=names)
    outputs = parser(tmp_path, eval_mode="all").get_dataparser_outputs()
    assert outputs.image_filenames == sorted(tmp_path / "images" / name for name in names)


def test_nerfstudios_datamanager_takes_it(tmp_path):
    """Distorted cameras: nerfstudio must find nothing left to undistort."""
    from nerfstudio.data.datamanagers.full_images_datamanager import (
        FullImageDatamanager,
        FullImageDatamanagerConfig,
    )

    write_model(tmp_path / "sparse/0", params=lambda w, h: ("SIMPLE_RADIAL", [w, w / 2, h / 2, -0.1]))
    write_photos(tmp_path / "images")
    config = FullImageDatamanagerConfig(
        dataparser=AbcdDataParserConfig(), data=tmp_path, cache_images_type="uint8"
    )
    manager = FullImageDatamanager[AbcdDataset](config)
    parsed = parser(tmp_path).get_dataparser_outputs("test")
    for (camera, data), wanted in zip(manager.fixed_indices_eval_dataloader, parsed.cameras, strict=True):
        assert data["image"].shape == (camera.height.item(), camera.width.item(), 3)
        assert torch.equal(camera.fx.ravel(), wanted.fx.ravel())
    camera, data = manager.next_train(0)
    expected = manager.train_dataset.photos.image(camera.metadata["cam_idx"])
    assert torch.equal(data["image"], expected)


def test_check_reads_once_and_names_faults(scene):
    checked = parser(scene)
    checked.check()
    shutil.rmtree(scene / "sparse")
    assert len(checked.get_dataparser_outputs().image_filenames) == 8
    with pytest.raises(InputError, match="holds no model"):
        parser(scene).check()


# transforms.json


def write_transforms(scene: Path, **extra) -> dict:
    """The COLMAP scene of the fixture as nerfstudio would write it, in place of the model."""
    model = read_colmap(scene, scene / "sparse/0")
    shutil.rmtree(scene / "sparse")
    frames = []
    for frame in reversed(model.frames):
        intrinsics = {"fl_x": frame.lens.fx, "fl_y": frame.lens.fy, "cx": frame.lens.cx, "cy": frame.lens.cy}
        pose = np.concatenate([frame.camera_to_world, [[0, 0, 0, 1]]]).tolist()
        size = {"w": frame.lens.width, "h": frame.lens.height}
        frames.append({"file_path": f"images/{frame.name}", "transform_matrix": pose, **intrinsics, **size})
    rows = "\n".join(
        " ".join(map(str, [*p, *c])) for p, c in zip(model.points_xyz, model.points_rgb, strict=True)
    )
    types = [f"property double {axis}\n" for axis in "xyz"]
    types += [f"property uint8 {color}\n" for color in ("red", "green", "blue")]
    head = f"ply\nformat ascii 1.0\nelement vertex {len(model.points_xyz)}\n{''.join(types)}end_header\n"
    (scene / "points.ply").write_text(head + rows + "\n")
    meta = {"ply_file_path": "points.ply", "applied_transform": Z_UP.tolist(), "frames": frames, **extra}
    (scene / "transforms.json").write_text(json.dumps(meta))
    return meta


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
    plain = write_transforms(scene)
    centers = parser(scene).get_dataparser_outputs()
    (scene / "transforms.json").write_text(json.dumps({**plain, "applied_scale": 0.25}))
    scaled = parser(scene).get_dataparser_outputs()
    assert torch.equal(scaled.cameras.camera_to_worlds, centers.cameras.camera_to_worlds)
    back, quarter = (
        o.transform_poses_to_original_space(o.cameras.camera_to_worlds) for o in (scaled, centers)
    )
    assert torch.allclose(back[..., 3], quarter[..., 3] / 0.25, atol=1e-5)


def test_angle_of_view_and_size_from_the_photo(scene):
    meta = write_transforms(scene)
    frames = [
        {"file_path": f["file_path"], "transform_matrix": f["transform_matrix"]} for f in meta["frames"]
    ]
    (scene / "transforms.json").write_text(json.dumps({"camera_angle_x": np.pi / 2, "frames": frames}))
    outputs = parser(scene, eval_mode="all").get_dataparser_outputs()
    assert torch.allclose(outputs.cameras.fx * 2, outputs.cameras.width.float())
    assert torch.equal(outputs.cameras.fx, outputs.cameras.fy)
    assert torch.equal(outputs.cameras.cx * 2, outputs.cameras.width.float())


def test_masks_of_all_frames_reach_the_dataset(scene):
    meta = write_transforms(scene)
    for frame in meta["frames"]:
        mask = np.full((frame["h"], frame["w"]), 255, np.uint8)
        mask[:, : frame["w"] // 2] = 0
        frame["mask_path"] = frame["file_path"].replace("images", "masks")
        (scene / frame["mask_path"]).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(mask).save(scene / frame["mask_path"])
    (scene / "transforms.json").write_text(json.dumps(meta))
    data = AbcdDataset(parser(scene).get_dataparser_outputs())[0]
    width = data["image"].shape[1]
    assert data["mask"].shape == (*data["image"].shape[:2], 1)
    assert data["mask"].dtype == torch.bool
    assert not data["mask"][:, : width // 2].any()
    assert data["mask"][:, width // 2 :].all()
    del meta["frames"][0]["mask_path"]
    (scene / "transforms.json").write_text(json.dumps(meta))
    assert "9 of 10 frames have a mask_path" in refusal(scene)


def _spoil(key: str, value) -> Callable[[dict], None]:
    return lambda meta: meta["frames"][3].__setitem__(key, value)


def _spoil_pose(row: int, column: int, value: float) -> Callable[[dict], None]:
    return lambda meta: meta["frames"][3]["transform_matrix"][row].__setitem__(column, value)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_spoil_pose(0, 3, float("nan")), "NaN"),
        (_spoil_pose(1, 1, float("inf")), "NaN or infinity"),
        (_spoil_pose(0, 0, 3.0), "no rotation"),
        (_spoil("transform_matrix", (np.diag([1, 1, -1, 1]) + 0.0).tolist()), "mirrors"),
        (_spoil("transform_matrix", [[1, 0], [0, 1]]), "4 x 4"),
        (_spoil("transform_matrix", [[1, 0], [0]]), "matrix"),
        (_spoil("transform_matrix", None), "matrix"),
        (_spoil("fl_x", -500), "focal length"),
        (_spoil("fl_x", "wide"), "must be a number"),
        (_spoil("w", 0), "size"),
        (_spoil("k4", 0.1), "k4"),
        (_spoil("k1", -40.0), "leaves no picture"),
        (_spoil("file_path", "../../etc/passwd"), "leads out"),
        (_spoil("file_path", "/etc/passwd"), "leads out"),
        (_spoil("mask_path", "../mask.png"), "leads out"),
        (_spoil("file_path", 7), "no file_path"),
        (lambda meta: meta.update(ply_file_path="../points.ply"), "leads out"),
        (lambda meta: meta.update(ply_file_path="gone.ply"), "does not exist"),
        (lambda meta: meta.update(camera_model="EQUIRECTANGULAR"), "EQUIRECTANGULAR"),
        (lambda meta: meta.update(frames=[]), "no list of frames"),
        (lambda meta: meta.update(frames=meta["frames"][:1]), "at least 2"),
        (lambda meta: meta.update(frames=meta["frames"] + meta["frames"][:1]), "twice"),
        (lambda meta: meta.update(applied_scale=0), "positive"),
    ],
)
def test_bad_transforms_json_is_refused(scene, spoil, message):
    meta = write_transforms(scene)
    spoil(meta)
    (scene / "transforms.json").write_text(json.dumps(meta))
    said = refusal(scene)
    assert message in said
    assert len(said.splitlines()) <= 2


def test_file_that_is_no_json_is_refused(scene):
    write_transforms(scene)
    (scene / "transforms.json").write_text('{"frames": [')
    assert "not valid JSON" in refusal(scene)


@pytest.mark.parametrize("order", ["<", ">"])
def test_binary_ply(tmp_path, order):
    xyz, rgb = np.arange(12.0).reshape(4, 3), np.arange(12, dtype=np.uint8).reshape(4, 3)
    row = [(name, order + "f4") for name in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")]
    table = np.array([(*p, *c) for p, c in zip(xyz, rgb, strict=True)], dtype=row)
    kind = "little" if order == "<" else "big"
    types = "".join(f"property {'uchar' if t == 'u1' else 'float'} {name}\n" for name, t in row)
    head = f"ply\nformat binary_{kind}_endian 1.0\nelement vertex 4\n{types}end_header\n".encode()
    path = tmp_path / "points.ply"
    path.write_bytes(head + table.tobytes())
    assert np.array_equal(read_points(path)[0], xyz)
    assert np.array_equal(read_points(path)[1], rgb)
    for broken in (
        head + table.tobytes()[:-1],
        head + table.tobytes() + b"!",
        b"",
        head.replace(b"4\n", b"-4\n"),
    ):
        path.write_bytes(broken)
        with pytest.raises(InputError, match=r"points\.ply"):
            read_points(path)


# What is refused


def test_missing_scene_says_where_to_get_it(tmp_path):
    said = refusal(tmp_path / "garden")
    assert "does not exist" in said
    assert "jonbarron.info/mipnerf360" in said
    assert "sparse/0/cameras.bin" in refusal(tmp_path)


def test_missing_photo_folder_is_one_line(scene):
    shutil.rmtree(scene / "images")
    said = refusal(scene)
    assert "put the 10 photos" in said
    assert "\n" not in said


@pytest.mark.parametrize("file", ["cameras.bin", "images.bin", "points3D.bin"])
@settings(
    derandomize=True,
    max_examples=25,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(share=st.floats(0, 1, exclude_max=True))
def test_cut_model_is_refused(scene, file, share):
    path = scene / "sparse/0" / file
    whole = path.read_bytes()
    try:
        for size in (int(share * len(whole)), len(whole) - 1):
            path.write_bytes(whole[:size])
            assert file in refusal(scene)
        path.write_bytes(whole + b"\0")
        assert "more than its entries" in refusal(scene)
    finally:
        path.write_bytes(whole)


@pytest.mark.parametrize("file", ["cameras.bin", "images.bin", "points3D.bin"])
def test_absurd_counts_are_refused(scene, file):
    path = scene / "sparse/0" / file
    path.write_bytes(b"\xff" * 8 + path.read_bytes()[8:])
    assert "claims" in refusal(scene)
    path.unlink()
    assert file in refusal(scene)
    os.mkfifo(path)
    assert "not a regular file" in refusal(scene)


@pytest.mark.parametrize("file", ["cameras.txt", "images.txt", "points3D.txt"])
def test_broken_text_model_names_the_line(tmp_path, file):
    write_model(tmp_path / "sparse/0", text=True)
    write_photos(tmp_path / "images")
    path = tmp_path / "sparse/0" / file
    lines = path.read_text().splitlines()
    bad = next(i for i, line in enumerate(lines) if line and not line.startswith("#"))
    lines[bad] = "1 what"
    path.write_text("\n".join(lines))
    assert f"{file}, line {bad + 1}" in refusal(tmp_path)


def test_unsupported_camera_model_is_named(tmp_path):
    write_model(tmp_path / "sparse/0", params=lambda w, h: ("FOV", [w, w, w / 2, h / 2, 0.5]))
    assert "image_undistorter" in refusal(tmp_path)
    shutil.rmtree(tmp_path / "sparse")
    write_model(tmp_path / "sparse/0", text=True, params=lambda w, h: ("FOV", [w, w, w / 2, h / 2, 0.5]))
    assert "model FOV" in refusal(tmp_path)


@pytest.mark.parametrize("focal", [-50.0, 0.0, 1e9, float("nan")])
def test_absurd_focal_is_refused(scene, focal):
    path = scene / "sparse/0/cameras.bin"
    data = bytearray(path.read_bytes())
    struct.pack_into("<d", data, 8 + 24, focal)
    path.write_bytes(data)
    assert "camera" in refusal(scene)


def test_pose_with_nan_is_refused(scene):
    path = scene / "sparse/0/images.bin"
    data = bytearray(path.read_bytes())
    struct.pack_into("<d", data, 8 + 4, float("nan"))
    path.write_bytes(data)
    assert "NaN" in refusal(scene)


def test_cameras_at_one_place_are_refused(tmp_path):
    write_model(tmp_path / "sparse/0", text=True)
    write_photos(tmp_path / "images")
    lines = (tmp_path / "sparse/0/images.txt").read_text().splitlines()
    for i, line in enumerate(lines):
        words = line.split()
        if len(words) == 10 and not line.startswith("#"):
            lines[i] = " ".join([words[0], *"1000000", *words[8:]])
    (tmp_path / "sparse/0/images.txt").write_text("\n".join(lines) + "\n")
    assert "all cameras at one place" in refusal(tmp_path)


def test_camera_that_the_model_lacks_is_named(tmp_path):
    write_model(tmp_path / "sparse/0", text=True)
    write_photos(tmp_path / "images")
    path = tmp_path / "sparse/0/cameras.txt"
    path.write_text("\n".join(line for line in path.read_text().splitlines() if not line.startswith("2")))
    assert "uses camera 2" in refusal(tmp_path)


def test_name_that_leaves_the_photo_folder_is_refused(tmp_path):
    write_model(tmp_path / "sparse/0", names=["../../secret.png", "b.png"])
    assert "leads out" in refusal(tmp_path)


def _png_16(path: Path) -> None:
    """16-bit RGB, which Pillow reads but cannot write: patch the depth in the header of an 8-bit file."""
    Image.new("RGB", SIZES[0]).save(path)
    data = bytearray(path.read_bytes())
    data[24] = 16
    # The checksum covers the depth.
    struct.pack_into(">I", data, 29, zlib.crc32(bytes(data[12:29])))
    path.write_bytes(data)


def _bomb(path: Path) -> None:
    _png_16(path)
    data = bytearray(path.read_bytes())
    data[24] = 8
    struct.pack_into(">II", data, 16, 12_000, 9_000)
    struct.pack_into(">I", data, 29, zlib.crc32(bytes(data[12:29])))
    path.write_bytes(data)


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def _cut_jpeg(path: Path) -> None:
    Image.open(path).convert("RGB").save(path, format="JPEG")
    path.write_bytes(path.read_bytes()[:-30])


def _fifo(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def _dangling(path: Path) -> None:
    path.unlink()
    path.symlink_to("nowhere.png")


def _turned(path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.new("RGB", SIZES[0][::-1]).save(path, format="JPEG", exif=exif)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda p: p.unlink(), "cannot be read"),
        (lambda p: p.write_bytes(b""), "is empty"),
        (lambda p: p.write_bytes(b"not a picture at all"), "not a picture"),
        (_cut, "damaged"),
        (_cut_jpeg, "damaged"),
        (_fifo, "not a regular file"),
        (_dangling, "link to nothing"),
        (_png_16, "8 bits"),
        (lambda p: Image.fromarray(np.zeros(SIZES[0][::-1], np.uint16)).save(p), "8 bits"),
        (lambda p: Image.new("CMYK", SIZES[0]).save(p, format="JPEG"), "CMYK"),
        (_bomb, "89 Mpx"),
        (lambda p: Image.new("RGB", (SIZES[0][0] + 1, SIZES[0][1])).save(p), "its camera is 61 x 41"),
        (_turned, "EXIF"),
    ],
)
def test_bad_photo_is_named_with_its_fault(scene, spoil, message):
    path = scene / "images" / NAMES[0]
    spoil(path)
    said = refusal(scene)
    assert str(path) in said
    assert message in said
    assert "\n" not in said


def test_all_bad_photos_are_listed_at_once(scene):
    bad = [scene / "images" / name for name in NAMES[:3]]
    for path in bad:
        path.write_bytes(b"")
    said = refusal(scene).splitlines()
    assert sorted(said) == sorted(f"{path} is empty; copy the photo again." for path in bad)


def test_long_lists_are_cut_with_a_count():
    problems = Problems(limit=3)
    for i in range(5):
        problems.add(f"file\n{i}")
    with pytest.raises(InputError) as caught:
        problems.raise_if_any()
    assert str(caught.value).splitlines()[2:] == ["file\\n2", "... and 2 more like these (5 in all)."]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"downscale_factor": 0}, "downscale-factor"),
        ({"downscale_factor": 2.5}, "downscale-factor"),
        ({"downscale_factor": 50}, "leaves nothing"),
        ({"eval_interval": 1}, "eval-interval"),
    ],
)
def test_impossible_options_are_refused(scene, options, message):
    assert message in refusal(scene, **options)


# Real scenes


@pytest.mark.parametrize("name", ["castle-P30", "fox"])
@pytest.mark.parametrize("factor", [1, 2])
def test_real_scene_projects_as_pycolmap_does(name, factor):
    if not (REAL / name).is_dir():
        pytest.skip(f"{REAL / name} is not there; set ABCD_DATA to a folder that holds it")
    model = pycolmap.Reconstruction(str(REAL / name / "sparse/0"))
    outputs = parser(REAL / name, downscale_factor=factor, eval_mode="all").get_dataparser_outputs()
    dataset = AbcdDataset(outputs)
    for row in (0, 7):
        image = model.find_image_with_name(outputs.image_filenames[row].name)
        camera = model.camera(image.camera_id)
        xyz = np.stack([point.xyz for _, point in sorted(model.points3D.items())])
        local = image.cam_from_world() * xyz
        front = local[:, 2] > 1e-3 * np.abs(local).max()
        size = np.array([camera.width // factor, camera.height // factor])
        expected = camera.img_from_cam(local[front]) * size / [camera.width, camera.height]
        near = np.abs(expected).max(axis=1) < 4 * max(camera.width, camera.height)
        assert np.abs(project(outputs, row)[front][near] - expected[near]).max() < 1e-2
        assert dataset.get_numpy_image(row).shape == (*size[::-1], 3)


def test_real_scene_without_photos_is_refused():
    if not (REAL / "garden_geometry").is_dir():
        pytest.skip(f"{REAL / 'garden_geometry'} is not there; set ABCD_DATA to a folder that holds it")
    assert "put the 185 photos" in refusal(REAL / "garden_geometry")
