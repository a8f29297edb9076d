"""Nerfstudio's tools on a run of ours: in this process, on a tiny scene."""

import copy
import json
import shutil
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
import yaml
from nerfstudio.cameras.cameras import CameraType
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from nerfstudio.scripts import render
from nerfstudio.scripts.eval import ComputePSNR
from nerfstudio.utils.eval_utils import eval_setup
from PIL import Image

from abcd_ns.engine.gaussians.initialize import cloud_from_points
from abcd_ns.engine.render.loss import psnr
from abcd_ns.errors import UserError
from abcd_ns.nerfstudio import metrics
from abcd_ns.nerfstudio.model import AbcdModel, AbcdModelConfig
from tests.nerfstudio.test_training import configure, run
from tests.reference.colmap_scene import HEIGHT, HELD_OUT, VIEWS, WIDTH


def pictures(folder: Path) -> dict[str, np.ndarray]:
    found = {path.relative_to(folder).as_posix(): path for path in sorted(folder.rglob("*.png"))}
    return {name: np.asarray(Image.open(path)).astype(float) for name, path in found.items()}


def camera_path(folder: Path, **extra) -> Path:
    """As the viewer writes it: three cameras before the wall, in its scaled coordinates."""
    config = yaml.load((folder / "config.yml").read_text(), Loader=yaml.Loader)
    dataset = config.pipeline.setup(device="cpu", test_mode="val").datamanager.train_dataset
    frames = []
    for row in range(3):
        pose = torch.eye(4)
        pose[:3] = dataset.cameras.camera_to_worlds[row]
        field = float(2 * torch.rad2deg(torch.atan(HEIGHT / 2 / dataset.cameras.fy[row, 0])))
        frames.append({"camera_to_world": pose.flatten().tolist(), "fov": field, "aspect": WIDTH / HEIGHT})
    path = {"render_width": WIDTH, "render_height": HEIGHT, "camera_type": "perspective", "seconds": 1}
    file = folder / "camera_path.json"
    file.write_text(json.dumps({**path, "camera_path": frames, "fps": 3, **extra}))
    return file


@pytest.fixture
def rendered(trained, tmp_path, monkeypatch):
    monkeypatch.setattr("nerfstudio.utils.install_checks.check_ffmpeg_installed", lambda: None)

    def draw(names: list[str], **extra) -> dict[str, np.ndarray]:
        out = tmp_path / "_".join([*names, *extra])
        render.RenderCameraPath(
            load_config=trained.base_dir / "config.yml",
            output_path=out / "frames.mp4",
            image_format="png",
            output_format="images",
            rendered_output_names=names,
            eval_num_rays_per_chunk=7,
            camera_path_filename=camera_path(trained.base_dir, **extra),
        ).main()
        return pictures(out / "frames")

    return draw


def test_a_camera_path_is_rendered_with_normals_and_median_depth_when_asked_for(rendered, monkeypatch):
    asked = []
    for name in ("draw_normals", "draw_median"):
        draws = getattr(AbcdModel, name)
        watched = lambda self, view, name=name, draws=draws: (asked.append(name), draws(self, view))[1]  # noqa: E731
        monkeypatch.setattr(AbcdModel, name, watched)
    frames = rendered(["rgb", "depth", "accumulation"])
    assert list(frames) == [f"{k:05d}.png" for k in range(3)]
    assert {frame.shape for frame in frames.values()} == {(HEIGHT, 3 * WIDTH, 3)}
    assert asked == []
    frames = rendered(["normals", "depth_median"])
    assert asked == 3 * ["draw_normals", "draw_median"]
    for frame in frames.values():
        assert frame.shape == (HEIGHT, 2 * WIDTH, 3)
        assert frame[:, :WIDTH].std() > 1
        assert frame[:, WIDTH:].std() > 1


def test_a_crop_box_leaves_what_is_in_it_on_its_own_background(rendered):
    whole = rendered(["rgb"])["00001.png"]
    crop = {"crop_bg_color": {"r": 255, "g": 0, "b": 255}, "crop_center": [9.0, 9.0, 9.0]}
    nothing = rendered(["rgb"], crop={**crop, "crop_scale": [0.1, 0.1, 0.1]})["00001.png"]
    assert (nothing == [255, 0, 255]).all()
    wide = {"crop_scale": [99.0, 99.0, 99.0], "crop_bg_color": {"r": 38, "g": 42, "b": 55}}
    everything = rendered(["rgb"], crop={**crop, **wide})["00001.png"]
    assert np.abs(everything - whole).max() <= 1


def test_pictures_without_background_have_alpha(rendered):
    rgba, rgb = rendered(["rgba"])["00001.png"], rendered(["rgb"])["00001.png"]
    assert rgba.shape == (HEIGHT, WIDTH, 4)
    alpha = rgba[..., 3:] / 255
    background = 255 * np.array([0.1490, 0.1647, 0.2157])
    assert np.abs(rgba[..., :3] * alpha + (1 - alpha) * background - rgb).max() < 3


def test_the_data_set_is_rendered_beside_its_photos(trained, tmp_path):
    options = {"image_format": "png", "split": "train+test"}
    render.DatasetRender(load_config=trained.base_dir / "config.yml", output_path=tmp_path, **options).main()
    found = pictures(tmp_path)
    kinds = ("gt-rgb", "rgb", "depth", "accumulation", "background", "normals", "depth_median")
    assert len(found) == len(kinds) * VIEWS
    names = [name.split("/")[-1] for name in found if name.startswith("test/rgb/")]
    assert len(names) == HELD_OUT
    for name in names:
        drawn, photo = (torch.from_numpy(found[f"test/{kind}/{name}"]) / 255 for kind in ("rgb", "gt-rgb"))
        assert float(psnr(drawn, photo)) > 12


def test_transparent_photos_are_written_on_the_background_of_the_pictures(data, trained, tmp_path):
    scene = shutil.copytree(data, tmp_path / "scene")
    for photo in (scene / "images").iterdir():
        picture = Image.open(photo)
        picture.putalpha(0)
        picture.save(photo)
    names, config = ["gt-rgb", "background"], trained.base_dir / "config.yml"
    options = {"rendered_output_names": names, "image_format": "png", "data": scene}
    render.DatasetRender(load_config=config, output_path=tmp_path / "out", **options).main()
    photos, backgrounds = (pictures(tmp_path / "out" / "test" / name) for name in names)
    assert len(photos) == HELD_OUT
    assert all((photos[name] == backgrounds[name]).all() for name in backgrounds)


# Scores


def evaluated(folder: Path, out: Path) -> dict:
    ComputePSNR(load_config=folder / "config.yml", output_path=out / "scores.json").main()
    return json.loads((out / "scores.json").read_text())["results"]


def test_without_weights_lpips_is_null_and_says_why(trained, tmp_path, monkeypatch):
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path / "hub"))
    monkeypatch.delenv(metrics.FETCH, raising=False)
    found = evaluated(trained.base_dir, tmp_path)
    assert found["lpips"] is None
    assert found["psnr"] > 12
    assert "ABCD_FETCH_LPIPS=1" in found["lpips_missing"]
    assert str(tmp_path / "hub") in found["lpips_missing"]
    assert not (tmp_path / "hub").exists()


def test_weights_are_fetched_when_that_is_allowed(trained, tmp_path, monkeypatch):
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path / "hub"))
    monkeypatch.setenv(metrics.FETCH, "1")
    monkeypatch.setattr(metrics, "_lpips", lambda _: lambda a, b: (a - b).abs().mean())
    found = evaluated(trained.base_dir, tmp_path)
    assert 0 < found["lpips"] < 1
    assert "lpips_missing" not in found

    monkeypatch.undo()
    fails = Mock(side_effect=OSError("no route to host"))
    monkeypatch.setattr("torchmetrics.image.lpip.LearnedPerceptualImagePatchSimilarity", fails)
    with pytest.raises(UserError, match="no route to host"):
        metrics._lpips("nowhere")


def test_a_name_that_is_no_output_is_answered_by_names_alone(trained):
    _, pipeline, _, _ = eval_setup(trained.base_dir / "config.yml")
    camera, _ = next(iter(pipeline.datamanager.fixed_indices_eval_dataloader))
    assert "tensor" not in repr(pipeline.model.get_outputs_for_camera(camera).keys())
    with pytest.raises(UserError, match="abcd mesh"):
        pipeline.model.get_outputs_for_camera_ray_bundle(camera.generate_rays(0, keep_shape=True))


def test_a_path_of_fisheye_cameras_is_one_line_and_a_preview_in_the_viewer(
    trained, rendered, monkeypatch, said_at_exit
):
    config = trained.base_dir / "config.yml"
    _, pipeline, _, _ = eval_setup(config)
    camera, _ = next(iter(pipeline.datamanager.fixed_indices_eval_dataloader))
    straight = pipeline.model.view(camera)
    camera.camera_type = torch.full_like(camera.camera_type, CameraType.FISHEYE.value)
    with monkeypatch.context() as patched:
        patched.setattr("abcd_ns.viewer.pictures.asked_by_viewer", lambda: True)
        assert torch.equal(pipeline.model.view(camera).viewmat, straight.viewmat)
    monkeypatch.setattr("sys.argv", ["ns-render", "camera-path", "--load-config", str(config)])
    assert "error: Camera 0 is fisheye" in said_at_exit(rendered, ["rgb"], camera_type="fisheye")


def test_a_box_without_gaussians_ends_an_export_in_one_line(trained, monkeypatch, said_at_exit):
    box = ["--obb_center", "9", "9", "9", "--obb-rotation", "0", "0", "0", "--obb_scale"]
    words = ["ns-export", "gaussian-splat", "--load-config", str(trained.base_dir / "config.yml"), *box]
    monkeypatch.setattr("sys.argv", [*words, "99", "99", "99"])
    eval_setup(trained.base_dir / "config.yml")
    monkeypatch.setattr("sys.argv", [*words, "0.1", "0.1", "0.1"])
    assert "error: No Gaussian lies in this box" in said_at_exit(eval_setup, trained.base_dir / "config.yml")


def test_an_export_of_degree_0_has_the_colours_that_are_drawn():
    config = AbcdModelConfig(sh_degree=0)
    model = config.setup(scene_box=SceneBox(torch.zeros(2, 3)), num_train_data=1)
    color = torch.tensor([[0.8, 0.5, 0.1]])
    gaussians = cloud_from_points(torch.zeros(1, 3), 255 * color, sh_degree=0).gaussians()
    model.gauss_params["features_dc"] = torch.nn.Parameter(gaussians.features_dc)
    assert model.colors.allclose(color, atol=0.01)
    assert torch.equal(model.shs_0, gaussians.features_dc)


def test_a_run_opens_where_it_was_moved_to(trained, tmp_path, monkeypatch, said_at_exit):
    moved = shutil.copytree(trained.base_dir, tmp_path / "renamed")
    monkeypatch.setattr("sys.argv", ["ns-eval", "--load-config", str(moved / "config.yml")])
    _, _, checkpoint, _ = eval_setup(moved / "config.yml")
    assert checkpoint.parent == moved / "nerfstudio_models"
    checkpoint.unlink()
    assert f"{checkpoint.parent} has no checkpoint" in said_at_exit(eval_setup, moved / "config.yml")


@pytest.mark.parametrize(("moved", "words"), [("data", "elsewhere"), ("photos", "is not a picture")])
def test_what_a_user_can_repair_ends_a_tool_in_one_line(
    data, trained, tmp_path, monkeypatch, said_at_exit, moved, words
):
    scene = tmp_path / "elsewhere"
    if moved == "photos":
        for photo in (Path(shutil.copytree(data, scene)) / "images").iterdir():
            photo.write_bytes(b"no photo")
    config = yaml.load((trained.base_dir / "config.yml").read_text(), Loader=yaml.Loader)
    config.data = config.pipeline.datamanager.data = scene
    folder = Path(shutil.copytree(trained.base_dir, tmp_path / "run"))
    (folder / "config.yml").write_text(yaml.dump(config))
    monkeypatch.setattr("sys.argv", ["ns-eval", "--load-config", str(folder / "config.yml")])
    said = said_at_exit(evaluated, folder, tmp_path)
    assert "error:" in said
    assert words in said


# Classes derived from ours


class Tinted(AbcdModel):
    """Splatfacto's kind of derived model: a module of its own, a loss, an optimizer, a score."""

    def populate_modules(self):
        super().populate_modules()
        self.tint = torch.nn.Linear(3, 3)
        torch.nn.init.constant_(self.tint.weight, 0.5)

    def get_param_groups(self):
        return {**super().get_param_groups(), "tint": list(self.tint.parameters())}

    def get_loss_dict(self, outputs, batch, metrics_dict=None):
        losses = super().get_loss_dict(outputs, batch, metrics_dict)
        return {**losses, "tint": self.tint.weight.square().sum()}

    def get_image_metrics_and_images(self, outputs, batch):
        scores, images = super().get_image_metrics_and_images(outputs, batch)
        photo, drawn = (x.permute(2, 0, 1)[None] for x in (self.get_gt_img(batch["image"]), outputs["rgb"]))
        again = {"psnr_again": self.psnr(drawn, photo), "ssim_again": self.ssim(drawn, photo)}
        return {**scores, **{name: float(value) for name, value in again.items()}}, images


def test_a_derived_model_trains_is_saved_and_loads(data, tmp_path):
    config = configure(data, tmp_path, steps=8)
    config.pipeline.model._target = Tinted
    config.optimizers = copy.deepcopy(config.optimizers)
    config.optimizers["tint"] = {"optimizer": AdamOptimizerConfig(lr=0.1), "scheduler": None}
    trainer = run(config)
    _, pipeline, _, _ = eval_setup(trainer.base_dir / "config.yml")
    assert isinstance(pipeline.model, Tinted)
    tint = pipeline.model.tint.weight
    assert torch.equal(tint, trainer.pipeline.model.tint.weight)
    assert float(tint.detach().abs().max()) < 0.3
    found = pipeline.get_average_eval_image_metrics()
    assert found["psnr_again"] == pytest.approx(found["psnr"], abs=1e-3)
    assert found["ssim_again"] == pytest.approx(found["ssim"], abs=1e-3)
