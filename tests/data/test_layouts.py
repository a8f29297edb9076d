"""Folders that are laid out otherwise: photos and masks elsewhere, a file for each split, other splits."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from PIL import Image

from abcd_ns.data.dataset import AbcdDataset
from abcd_ns.nerfstudio.inspection import inspect
from tests.data.dataparser_scenes import (
    NAMES,
    SIZES,
    add_mask,
    parser,
    refusal,
    write_capture,
    write_photos,
    write_transforms,
)


def write_blender(folder: Path, splits: tuple[str, ...] = ("train", "val", "test")) -> Path:
    """Three photos with alpha for each split, taken from a circle, as Blender scenes have them."""
    rng = np.random.default_rng(0)
    for number, split in enumerate(splits):
        frames = []
        (folder / split).mkdir(parents=True)
        for k in range(3):
            angle = 0.7 * (3 * number + k)
            pose = np.eye(4)
            pose[:3, 0] = [np.cos(angle), np.sin(angle), 0]
            pose[:3, 2] = [np.sin(angle), -np.cos(angle), 0]  # it looks along -z at the middle
            pose[:3, 1] = [0, 0, 1]
            pose[:3, 3] = 4 * pose[:3, 2]
            rgba = rng.integers(0, 256, (24, 32, 4), dtype=np.uint8)
            Image.fromarray(rgba).save(folder / split / f"r_{k}.png")
            frames.append({"file_path": f"./{split}/r_{k}", "transform_matrix": pose.tolist()})
        meta = {"camera_angle_x": 0.7, "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(meta))
    return folder


# Photos and masks elsewhere


def test_transparent_photos_are_colours_on_a_background_to_ns_render_and_the_viewer(tmp_path):
    """ns-render dataset draws pictures of more than three channels by their principal components."""
    outputs = parser(write_blender(tmp_path)).get_dataparser_outputs()
    usual, shown = (AbcdDataset(outputs, behind=behind) for behind in (None, (0.2, 0.4, 0.6)))
    stored = shown.get_data(0, "uint8")["image"].float() / 255
    assert stored.shape == (24, 32, 4)
    assert torch.equal(usual[0]["image"], stored)
    color, alpha = stored[..., :3], stored[..., 3:]
    expected = alpha * color + (1 - alpha) * torch.tensor([0.2, 0.4, 0.6])
    assert torch.allclose(shown[0]["image"], expected, atol=1e-6)


@pytest.mark.parametrize("called", ["{stem}.png", "{name}.png", "{name}"])
def test_masks_of_a_colmap_model_are_found_by_name(scene, called):
    for i, name in enumerate(NAMES):
        mask = np.full(SIZES[i % 2][::-1], 255, np.uint8)
        mask[:, :9] = 0
        path = scene / "masks" / Path(name).parent / called.format(stem=Path(name).stem, name=Path(name).name)
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(mask).save(path)
    read = parser(scene, masks_path=Path("masks"))
    inspect(read.config)
    dataset = AbcdDataset(read.get_dataparser_outputs())
    mask, image = dataset[0]["mask"], dataset[0]["image"]
    assert (mask.dtype, mask.shape) == (torch.bool, (*image.shape[:2], 1))
    assert not mask[:, :9].any()
    assert mask[:, 9:].all()
    assert "mask" not in AbcdDataset(parser(scene).get_dataparser_outputs())[0]


@pytest.mark.parametrize("kind", ["colmap", "transforms"])
@pytest.mark.parametrize("called", ["{folder}/{stem}.png", "{folder}/{name}.png"])
def test_a_mask_beside_a_missing_photo_is_not_taken_for_it(tmp_path, kind, called):
    write_capture(tmp_path, names=[name.replace(".png", ".jpg") for name in NAMES])
    model, masks, options = shutil.copytree(tmp_path / "sparse", tmp_path / "kept"), [], {}
    write_transforms(tmp_path, lambda frame: masks.append(add_mask(tmp_path, frame, called)))
    if kind == "colmap":
        (tmp_path / "transforms.json").unlink()
        model.rename(tmp_path / "sparse")
        options = {"masks_path": Path("images")}
    found = parser(tmp_path, eval_mode="all", **options).prepared().sources
    assert sorted(source.mask_path for source in found) == sorted(masks)
    found[3].path.unlink()
    assert f"{found[3].mask_path} is all there is of " in refusal(tmp_path, **options)


def test_a_photo_is_not_its_own_mask(scene):
    photo = scene / "images" / NAMES[1]
    mask = shutil.copy(photo, photo.with_name(f"{photo.name}.png"))
    sources = parser(scene, masks_path=Path("images")).prepared().sources
    assert [(source.path, source.mask_path) for source in sources if source.mask_path] == [(photo, mask)]


@pytest.mark.parametrize(("folder", "options"), [("Masks", {}), ("hidden", {"masks_path": Path("hidden")})])
def test_masks_are_not_offered_in_place_of_photos(scene, folder, options):
    (scene / "images").rename(scene / folder)
    assert "images-path" not in refusal(scene, **options)


def test_folders_of_a_colmap_model_mean_nothing_to_transforms_json(scene):
    write_transforms(scene)
    assert "names photos and masks itself" in refusal(scene, masks_path=Path("masks"))


# A file for each split


@pytest.mark.parametrize("splits", [("train", "test", "val"), ("train", "val")])
def test_blender_scenes_come_in_their_splits(tmp_path, splits):
    data = write_blender(tmp_path, splits)
    if "test" in splits:  # a split that is not used may lack its photos
        shutil.rmtree(data / "val")
    train, test = (parser(data).get_dataparser_outputs(split) for split in ("train", "test"))
    assert train.image_filenames == [data / f"train/r_{k}.png" for k in range(3)]
    assert {path.parent.name for path in test.image_filenames} == {splits[1]}
    assert AbcdDataset(train).get_data(0, "uint8")["image"].shape == (24, 32, 4)
    theirs = BlenderDataParserConfig(data=data).setup().get_dataparser_outputs("train")
    assert torch.allclose(train.cameras.fx, theirs.cameras.fx.float())
    back = train.transform_poses_to_original_space(train.cameras.camera_to_worlds, "opengl")
    assert torch.allclose(back.float(), theirs.cameras.camera_to_worlds, atol=1e-5)


def test_splits_in_different_worlds_are_refused(tmp_path):
    data = write_blender(tmp_path)
    meta = json.loads((data / "transforms_test.json").read_text())
    turned = [[0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0]]
    (data / "transforms_test.json").write_text(json.dumps({**meta, "applied_transform": turned}))
    assert "need the same applied_transform" in refusal(data)


# For other methods


def test_other_methods_do_not_reduce_photos(scene):
    assert "only ABCD's methods reduce" in refusal(scene, as_stored=True, downscale_factor=2)
    write_photos(scene / "images_2", divide=2)
    outputs = parser(scene, as_stored=True, downscale_factor=2).get_dataparser_outputs()
    assert outputs.cameras.width.max() == SIZES[0][0] // 2


def test_a_view_may_be_trained_on_and_held_out(tmp_path):
    data = write_blender(tmp_path, ("train",))
    assert (parser(data).rows("train"), parser(data).rows("test")) == ([1, 2], [0])  # without a split
    shutil.copy(data / "transforms_train.json", data / "transforms_test.json")
    found = parser(data)
    assert found.rows("train") == found.rows("test") == [0, 1, 2]
    (data / "transforms_test.json").write_text(json.dumps({"camera_angle_x": 0.7, "frames": []}))
    assert "To hold out every 8th view instead, move" in refusal(data)


def test_depths_and_normals_beside_a_split_are_no_photos_without_a_pose(tmp_path):
    data = write_blender(tmp_path)
    for k in range(9):
        Image.new("RGB", (32, 24)).save(data / "test" / f"r_{k}_depth_0001.png")
    assert "no pose" not in " ".join(parser(data).prepared().scene.notes)


def test_folders_that_are_links_are_searched_and_loops_end(scene):
    def as_on_windows(frame: dict) -> None:
        frame["file_path"] = "C:\\work\\" + frame["file_path"].replace("/", "\\")

    write_transforms(scene, as_on_windows)
    (scene / "images").rename(scene.parent / "elsewhere")
    (scene / "images").symlink_to(scene.parent / "elsewhere")
    (scene / "images" / "again").symlink_to(scene / "images")
    (scene / "images" / "everything").symlink_to("/")
    assert len(parser(scene).get_dataparser_outputs("train").image_filenames) > 0
