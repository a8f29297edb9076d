"""`ns-train abcd`, evaluation and pictures, in this process, on the simulated device."""

import pytest
import torch
import yaml
from nerfstudio.utils.eval_utils import eval_load_checkpoint

from abcd_ns.engine.types import Crop
from abcd_ns.run.fit import RamShares, device_budget
from abcd_ns.viewer.pictures import Choice, Show
from tests.nerfstudio.test_training import configure, run
from tests.reference.colmap_scene import HEIGHT, WIDTH, write_scene
from tests.reference.gsplat_stand_ins import lent
from tests.reference.simulated_device import DEVICE, simulated_device


@pytest.fixture(scope="module", autouse=True)
def counts():
    with simulated_device() as counts, lent():
        yield counts


def draw_for_viewer(trainer) -> None:
    """All that a viewer may ask for, in the middle of a visit."""
    model = trainer.pipeline.model
    if trainer.step % 5 == 0:
        camera = trainer.pipeline.datamanager.train_dataset.cameras[:1].to(DEVICE)
        camera.metadata = None
        outputs = model.get_outputs_for_camera(camera)
        assert outputs["rgb"].shape == (HEIGHT, WIDTH, 3)
        assert {outputs[name].device for name in ("rgb", "depth", "accumulation")} == {DEVICE}
        for show in Show:
            model.choice = Choice(show, None)
            assert model.draw_for_viewer(model.view(camera)).color.device == DEVICE
        model.choice = Choice()


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """As `ns-train --machine.device-type simulated` would have it."""
    data = write_scene(tmp_path_factory.mktemp("data") / "wall")
    config = configure(data, tmp_path_factory.mktemp("out"), steps=14, blocks=2)
    config.machine.device_type = DEVICE.type
    config.pipeline.training.density.refine_every = 3
    config.pipeline.training.density.refine_start = 0.0
    config.steps_per_eval_image = config.steps_per_eval_all_images = 10
    return run(config, after_step=draw_for_viewer)


def test_layers_and_photos_have_an_eighth_of_the_device_each(trained):
    pipeline = trained.pipeline
    eighth = device_budget(pipeline.config.device_budget_gb, DEVICE) // 8
    assert pipeline.datamanager.device_photo_bytes == eighth > 0
    assert pipeline.coordinator.layer_limit == eighth + RamShares.of(pipeline.config.ram_budget_gb).layers


def test_a_run_is_on_the_device_and_leaves_a_checkpoint(trained):
    assert trained.pipeline.device == DEVICE
    assert trained.pipeline.model.draws_with().name.startswith("gsplat")
    (checkpoint,) = trained.checkpoint_dir.iterdir()
    state = torch.load(checkpoint, weights_only=True)["pipeline"]
    assert {value.device.type for value in state.values() if isinstance(value, torch.Tensor)} == {"cpu"}


def test_a_checkpoint_is_evaluated_and_composited(trained):
    """Loaded as ns-eval does, but for the device, which it chooses itself."""
    config = yaml.load((trained.base_dir / "config.yml").read_text(), Loader=yaml.Loader)
    config.load_dir = trained.base_dir / "nerfstudio_models"
    pipeline = config.pipeline.setup(device=str(DEVICE), test_mode="test")
    pipeline.eval()
    eval_load_checkpoint(config, pipeline)
    assert pipeline.get_average_eval_image_metrics()["psnr"] > 8
    camera, _ = next(iter(pipeline.datamanager.fixed_indices_eval_dataloader))
    merged = pipeline.model.get_outputs_for_camera(camera)
    pipeline.model.config.render = "composited"
    composited = pipeline.model.get_outputs_for_camera(camera)
    assert merged["rgb"].device == composited["rgb"].device == DEVICE
    assert float((merged["rgb"] - composited["rgb"]).abs().max()) < 5e-4


def test_photos_are_copied_once_while_there_is_room_and_else_as_bytes(trained, counts, monkeypatch):
    manager = trained.pipeline.datamanager
    crop, rows = Crop(3, 2, 10, 8), range(len(manager.train_dataset))
    whole = manager.train_dataset.photos.image(0)
    expected = [manager.train_dataset.photos.image(row)[crop.slices].float() / 255 for row in rows]
    monkeypatch.setattr(manager, "_on_device", {})  # there was room for all in training
    monkeypatch.setattr(manager, "_used", 0)
    monkeypatch.setattr(manager, "device_photo_bytes", whole.nbytes)  # now for one
    for copies, size in (
        (len(rows), whole.nbytes + (len(rows) - 1) * 240),
        (len(rows) - 1, 240 * (len(rows) - 1)),
    ):
        before = counts.copy()
        found = [manager.photo(row, crop) for row in rows]
        taken = counts.since(before)
        assert (taken.copies_to_device, taken.bytes_to_device, taken.waited) == (copies, size, 0)
        assert all(torch.equal(pixels.cpu(), wanted) for pixels, wanted in zip(found, expected, strict=True))
