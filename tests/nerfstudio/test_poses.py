"""Refined poses in nerfstudio's tools: saved, seen by ns-eval and the viewer, and exported."""

import json

import pytest
import torch
from nerfstudio.scripts.exporter import ExportCameraPoses
from nerfstudio.scripts.render import DatasetRender
from nerfstudio.utils.eval_utils import eval_setup

from abcd_ns.engine.train.step import pose_rounds
from abcd_ns.nerfstudio.model import AbcdModel
from abcd_ns.nerfstudio.views import views_of
from tests.nerfstudio.test_training import configure, run
from tests.reference.colmap_scene import HELD_OUT, VIEWS, write_scene


@pytest.fixture(scope="module", params=["all", "interval"])
def trained(request, tmp_path_factory):
    """A run whose held-out photos are those of the training, or others; and the poses that it was given."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pose_rounds, "FIRST", 0.5)
        data, out = (tmp_path_factory.mktemp(name) for name in ("data", "out"))
        config = configure(write_scene(data / "wall"), out)
        config.pipeline.training.poses = "SO3xR3"
        config.pipeline.datamanager.dataparser.eval_mode = request.param
        given = config.pipeline.setup(device="cpu", test_mode="val").datamanager
        return run(config), given


def matrices(cameras) -> torch.Tensor:
    return torch.stack([view.viewmat for view in views_of(cameras)])


def test_a_checkpoint_holds_refined_poses_and_ns_eval_draws_from_them(trained):
    trainer, given = trained
    _, pipeline, _, _ = eval_setup(trainer.base_dir / "config.yml")
    refined = torch.stack([view.viewmat for view in trainer.pipeline.coordinator.views.values()])
    seen = matrices(pipeline.datamanager.train_dataset.cameras)
    assert torch.allclose(seen, refined, atol=1e-6)
    assert float((seen - matrices(given.train_dataset.cameras)).abs().max()) > 1e-4
    held, before = (matrices(d.eval_dataset.cameras) for d in (pipeline.datamanager, given))
    if len(held) == VIEWS:
        assert torch.allclose(held, refined, atol=1e-6)
    else:
        assert len(held) == HELD_OUT
        assert torch.equal(held, before)


def test_ns_export_cameras_writes_refined_poses(trained, tmp_path):
    trainer, _ = trained
    ExportCameraPoses(load_config=trainer.base_dir / "config.yml", output_dir=tmp_path / "out").main()
    frames = json.loads((tmp_path / "out" / "transforms_train.json").read_text())
    cameras = eval_setup(trainer.base_dir / "config.yml")[1].datamanager.train_dataset.cameras
    assert torch.equal(torch.tensor([frame["transform"] for frame in frames]), cameras.camera_to_worlds)
    assert len(json.loads((tmp_path / "out" / "transforms_eval.json").read_text())) > 0


def test_ns_render_dataset_draws_from_refined_poses(trained, tmp_path, monkeypatch):
    """Its cameras come from a datamanager of its own."""
    trainer, _ = trained
    config, drawn, view = trainer.base_dir / "config.yml", [], AbcdModel.view
    monkeypatch.setattr(AbcdModel, "view", lambda self, camera: (drawn.append(camera), view(self, camera))[1])
    options = {"rendered_output_names": ["rgb"], "image_format": "png", "split": "train+test"}
    DatasetRender(load_config=config, output_path=tmp_path, **options).main()
    manager = eval_setup(config)[1].datamanager
    known = [matrices(dataset.cameras) for dataset in (manager.train_dataset, manager.eval_dataset)]
    assert torch.equal(torch.cat([matrices(camera) for camera in drawn]), torch.cat(known))


def test_ns_render_dataset_leaves_photos_of_others_where_they_are(trained, tmp_path, monkeypatch, capsys):
    trainer, given = trained
    drawn, view = [], AbcdModel.view
    monkeypatch.setattr(AbcdModel, "view", lambda self, camera: (drawn.append(camera), view(self, camera))[1])
    options = {"rendered_output_names": ["rgb"], "image_format": "png", "split": "train"}
    other = write_scene(tmp_path / "other", prefix="other-")
    config = trainer.base_dir / "config.yml"
    DatasetRender(load_config=config, output_path=tmp_path, data=other, **options).main()
    expected = matrices(given.train_dataset.cameras)
    assert torch.equal(torch.cat([matrices(camera) for camera in drawn]), expected)
    assert capsys.readouterr().out.count("its refined poses are not used") == 1
