"""Pictures of a scene that the device could not draw at once: node by node, and still the merged picture."""

from types import SimpleNamespace
from unittest.mock import Mock

import torch
from nerfstudio.utils.eval_utils import eval_setup

from abcd_ns.engine.render import TorchRasterizer
from abcd_ns.nerfstudio.model import AbcdModel


def pictures(pipeline) -> list[dict]:
    pipeline.eval()
    loader = pipeline.datamanager.fixed_indices_eval_dataloader
    return [pipeline.model.get_outputs_for_camera(camera) for camera, _ in loader]


def test_a_checkpoint_is_drawn_by_nodes(trained, monkeypatch):
    drawn, draw = [], TorchRasterizer.draw

    def watched(self, gaussians, *args, **options):
        drawn.append(len(gaussians))
        return draw(self, gaussians, *args, **options)

    monkeypatch.setattr(TorchRasterizer, "draw", watched)
    _, pipeline, _, _ = eval_setup(trained.base_dir / "config.yml")
    expected, count = pictures(pipeline), len(pipeline.model.means)
    assert set(drawn) == {count}
    drawn.clear()
    monkeypatch.setattr(AbcdModel, "_most_at_once", lambda _: 1)
    _, pipeline, _, _ = eval_setup(trained.base_dir / "config.yml")
    found = pictures(pipeline)
    assert len(found) == len(expected) > 0
    for one, other in zip(found, expected, strict=True):
        for name in ("rgb", "accumulation"):  # drawing stops where 1e-4 of the light is left
            assert float((one[name] - other[name]).abs().max()) < 5e-4, name
        seen = other["accumulation"][..., 0] > 0.1
        torch.testing.assert_close(one["depth"][seen], other["depth"][seen], rtol=1e-2, atol=1e-2)
    assert max(drawn) < count
    assert len(drawn) > len(expected)


def test_scores_take_a_share_of_the_training_time(trained, monkeypatch, capsys):
    monkeypatch.setattr("abcd_ns.nerfstudio.pipeline.LEAST_SCORED", 1)
    _, pipeline, _, _ = eval_setup(trained.base_dir / "config.yml")
    there, told = len(pipeline.datamanager.eval_dataset), []
    run = SimpleNamespace(seconds=0.0)
    pipeline.coordinator = SimpleNamespace(stopwatch=run, pause=lambda: None, announce=told.append)
    draw = Mock(side_effect=pipeline.model.get_outputs_for_camera)
    monkeypatch.setattr(pipeline.model, "get_outputs_for_camera", draw)
    # Training seconds, of which a view takes 1; whether the run is complete; views.
    for seconds, finished, expected in ((1e6, False, there), (40.0, True, there), (40.0, False, 1)):
        pipeline._view_seconds, pipeline._scoring_seconds, run.seconds = 1.0, 0.0, seconds
        pipeline.coordinator.finished = finished
        draw.reset_mock()
        pipeline.get_average_eval_image_metrics()
        assert draw.call_count == expected
        assert ("held-out views" in capsys.readouterr().out) == (expected < there)
    assert len(told) == 3
    assert there == 2


def test_a_scene_that_is_too_large_stays_on_the_cpu(trained, monkeypatch):
    """The model's own device has no part in loading it."""
    checkpoint = torch.load(next(trained.checkpoint_dir.iterdir()), weights_only=True)
    _, pipeline, _, _ = eval_setup(trained.base_dir / "config.yml")
    monkeypatch.setattr(AbcdModel, "device", torch.device("meta"))
    monkeypatch.setattr(AbcdModel, "_most_at_once", lambda _: 1)
    pipeline.load_pipeline(checkpoint["pipeline"], checkpoint["step"])
    model = pipeline.model
    assert {value.device.type for value in model.gauss_params.values()} == {"cpu"}
    assert torch.equal(model.means, checkpoint["pipeline"]["_model.gauss_params.means"])
