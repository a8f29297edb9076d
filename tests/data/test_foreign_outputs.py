"""Photos and cameras of nerfstudio's own readers: as nerfstudio makes them, but checked and in our hands."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.datamanagers.full_images_datamanager import (
    FullImageDatamanager,
    FullImageDatamanagerConfig,
)
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.instant_ngp_dataparser import InstantNGPDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.data.datasets.base_dataset import InputDataset
from PIL import Image

from abcd_ns.data.dataset import PHOTOS, AbcdDataset, has_views, with_photos
from abcd_ns.data.input_errors import InputError
from abcd_ns.nerfstudio.dataparser import AbcdDataParserConfig
from abcd_ns.nerfstudio.inspection import Inspected, inspect
from tests.data.dataparser_scenes import SIZES, parser, write_capture, write_photos, write_transforms
from tests.data.test_layouts import write_blender

PINHOLE = {"fx": 40.0, "fy": 40.0, "cx": 16.0, "cy": 12.0, "width": 32, "height": 24}


def colmap(data: Path, factor: int = 1) -> ColmapDataParserConfig:
    return ColmapDataParserConfig(data=data, downscale_factor=factor, colmap_path=Path("sparse/0"))


def outputs_of(path: Path, **camera) -> DataparserOutputs:
    """Of one photo."""
    cameras = Cameras(camera_to_worlds=torch.eye(4)[None, :3], **{**PINHOLE, **camera})
    return DataparserOutputs(image_filenames=[path], cameras=cameras)


@pytest.fixture
def photo(tmp_path) -> Path:
    pixels = np.random.default_rng(0).integers(0, 256, (24, 32, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(tmp_path / "photo.png")
    return tmp_path / "photo.png"


@pytest.mark.parametrize("reader", ["nerfstudio's", "ours"])
@pytest.mark.parametrize(
    ("kind", "extra"),
    [("PINHOLE", []), ("OPENCV", [0.1, 0.01, 1e-3, 2e-3]), ("OPENCV_FISHEYE", [0.05, 0.01, 0.0, 0.0])],
)
def test_photos_and_cameras_are_those_that_splatfacto_trains_on(tmp_path, kind, extra, reader):
    """By nerfstudio's reader, and by ours as `ns-train splatfacto ... abcd-data` has it."""
    write_capture(tmp_path, params=lambda w, h: (kind, [w, w, w / 2, h / 2, *extra]))
    if reader == "ours":
        stored, trained = AbcdDataParserConfig(data=tmp_path, as_stored=True), parser(tmp_path)
    else:
        stored, trained = colmap(tmp_path), colmap(tmp_path).setup()
    config = FullImageDatamanagerConfig(dataparser=stored, cache_images_type="uint8")
    theirs = FullImageDatamanager[InputDataset](config).fixed_indices_eval_dataloader
    ours = AbcdDataset(trained.get_dataparser_outputs("val"))
    assert len(theirs) == len(ours) > 0
    for row, (camera, data) in enumerate(theirs):
        wanted = ours.cameras[row]
        for name in ("fx", "fy", "cx", "cy", "width", "height"):
            found = getattr(camera, name).item()
            assert found == pytest.approx(getattr(wanted, name).item(), abs=1e-3), name
            assert getattr(camera, name).dtype == getattr(wanted, name).dtype, name
        difference = data["image"].int() - ours.get_data(row, "uint8")["image"].int()
        assert difference.abs().max() <= 1
    assert ours.cameras.distortion_params is None


def test_transparent_photos_lie_on_the_readers_colour(tmp_path):
    data = write_blender(tmp_path)
    ours, theirs = (
        kind(BlenderDataParserConfig(data=data).setup().get_dataparser_outputs("train"))
        for kind in (AbcdDataset, InputDataset)
    )
    assert torch.allclose(ours[0]["image"], theirs[0]["image"], atol=0.5 / 255 + 1e-6)
    kept = BlenderDataParserConfig(data=data, alpha_color=None).setup().get_dataparser_outputs("train")
    assert AbcdDataset(kept).get_data(0, "uint8")["image"].shape == (24, 32, 4)


def test_masks_come_along_but_are_not_taken_for_missing_photos(photo):
    """Of photos whose names are of another machine, too."""
    mask = np.full((24, 32), 255, np.uint8)
    mask[:5] = 0
    Image.fromarray(mask).save(photo.parent / "mask.png")
    outputs = outputs_of(photo.parent / "C:\\me\\photo.jpg")
    outputs.mask_filenames = [photo.parent / "mask.png"]
    dataset = AbcdDataset(outputs)
    assert dataset.photos.sources[0].path == photo
    assert np.array_equal(dataset[0]["mask"][..., 0], mask > 0)
    outputs.mask_filenames = [photo]
    with pytest.raises(InputError, match="is all there is of"):
        AbcdDataset(outputs)


def test_a_larger_photo_is_reduced_to_its_camera(photo):
    dataset = AbcdDataset(outputs_of(photo, fx=20.0, fy=20.0, cx=8.0, cy=6.0, width=16, height=12))
    whole = np.array(Image.open(photo)).astype(float)
    means = whole.reshape(12, 2, 16, 2, 3).mean(axis=(1, 3))
    assert np.abs(dataset.get_numpy_image(0) - means).max() <= 0.5


@pytest.mark.parametrize(
    ("camera", "says"),
    [
        ({"width": 64, "height": 48}, "is 32 x 24 but its camera is 64 x 48"),
        ({"width": 24, "height": 24}, "is 32 x 24 but its camera is 24 x 24"),
        ({"camera_type": CameraType.EQUIRECTANGULAR}, "is equirectangular"),
        ({"distortion_params": torch.tensor([[0.0, 0, 0, 0.1, 0, 0]])}, "has k4 = 0.1"),
        ({"fx": 1e9}, "has the focal length"),
        (
            {"distortion_params": torch.tensor([[-40.0, 0, 0, 0, 0, 0]])},
            "a camera of 32 x 24 px has a distortion",
        ),
    ],
)
def test_cameras_that_cannot_be_are_named(photo, camera, says):
    with pytest.raises(InputError, match=f"{photo}:? {says}"):
        with_photos(outputs_of(photo, **camera))


@pytest.mark.parametrize(("share", "held_out"), [(0.6, 2), (0.8, 1), (1.0, 0)])
def test_instant_ngps_reader_may_hold_out_few_views_or_none(scene, share, held_out):
    meta = write_transforms(scene)
    frame = meta["frames"][0]
    alike = [each for each in meta["frames"] if each["w"] == frame["w"]]
    (scene / "transforms.json").write_text(json.dumps({**meta, **frame, "frames": alike}))
    reader = InstantNGPDataParserConfig(data=scene, eval_mode="fraction", train_split_fraction=share)
    assert inspect(reader).pixels == frame["w"] * frame["h"]
    tested = reader.setup().get_dataparser_outputs("val")
    assert len(tested.image_filenames) == held_out
    assert has_views(tested) == (held_out > 1)


def test_files_that_are_not_there_are_named_unless_nobody_looks_at_them(tmp_path):
    outputs = outputs_of(tmp_path / "gone.png")
    with pytest.raises(InputError, match=r"gone\.png cannot be read"):
        with_photos(outputs)
    (source,) = with_photos(outputs, needs_photos=False).metadata[PHOTOS]
    assert source.size == (32, 24)


def test_what_another_reader_cannot_do_is_refused(photo):
    outputs = outputs_of(photo)
    outputs.cameras.camera_to_worlds[:] = torch.nan
    with pytest.raises(InputError, match="--orientation-method"):
        with_photos(outputs)
    outputs.metadata = {"mask_color": (0, 0, 0)}
    with pytest.raises(InputError, match="--mask-color has no effect here"):
        with_photos(outputs)


# Looked at before training


def test_a_capture_is_measured(scene):
    assert inspect(colmap(scene)) == Inspected(8, 2, SIZES[0], 20, 1)
    write_photos(scene / "images_2", divide=2)
    half = Inspected(8, 2, (SIZES[0][0] // 2, SIZES[0][1] // 2), 20, 2)
    assert inspect(colmap(scene, factor=2)) == half
    said = "8 views to train on, 2 held out; photos of up to {} x {} px, divided by 2."
    assert half.in_words() == said.format(*half.size)
    without_points = BlenderDataParserConfig(data=write_blender(scene / "lego"))
    assert inspect(without_points) == Inspected(3, 3, (32, 24), 0, 1)


@pytest.mark.parametrize(
    ("config", "called"),
    [(NerfstudioDataParserConfig, "nerfstudio-data"), (BlenderDataParserConfig, "blender-data")],
)
def test_what_another_reader_stumbles_over_is_one_line(scene, config, called):
    with pytest.raises(InputError) as refused:
        inspect(config(data=scene))
    (line,) = refused.value.lines
    for words in (f"{called} cannot read", str(scene), "--help` lists its options"):
        assert words in line
