"""Whole trainings by the engine on the simulated device: whatever is on the wrong side raises."""

import gc
import weakref

import pytest
import torch

from abcd_ns.engine.events import BlockSplit, PrunedAtEnd
from abcd_ns.engine.gaussians.block_state import MOMENTS
from abcd_ns.engine.store.scene import HeldScene
from abcd_ns.engine.train.density.control import DensityConfig
from abcd_ns.engine.train.step import pose_rounds
from abcd_ns.engine.train.training_loop import train
from abcd_ns.peers.exact import ExactTrainer
from abcd_ns.peers.independent import independent_blocks, independent_trainer
from tests.reference.scenes import STILL, listen, stop, whole_scene
from tests.reference.simulated_device import DEVICE

GROWING = DensityConfig(refine_start=0.0, refine_stop=1.0, refine_every=3, split_pixels=0.0)


@pytest.fixture
def target(photos):
    return lambda sample: (photos(sample.view.index, sample.crop).to(DEVICE), None)


def assert_on_device(coordinator) -> None:
    """The active block is all there: parameters, moments, and Adam's steps."""
    for name, parameter in coordinator.params.items():
        state = coordinator.optimizers[name].state[parameter]
        assert {parameter.device, *(state[key].device for key in ("step", *MOMENTS))} == {DEVICE}


APART = {"kind": independent_trainer, "content": independent_blocks, "layers": False, "migrate": False}


@pytest.mark.parametrize(
    ("blocks", "steps", "options"),
    [
        (1, 8, {}),
        (4, 16, {"density": GROWING, "layers": False}),
        (3, 8, {"kind": ExactTrainer}),
        (2, 6, {**APART, "overlap": 0.25}),
    ],
    ids=["one", "four-ablated", "jointly", "apart"],
)
def test_blocks_are_trained(on_device, start, photos, blocks, steps, options):
    coordinator = on_device(blocks=blocks, steps=steps, **{"density": GROWING, **options})
    train(coordinator, photos, steps=3)
    if "kind" not in options:
        assert_on_device(coordinator)
    train(coordinator, photos)
    scene = whole_scene(coordinator)
    assert coordinator.state.step == steps
    assert len(scene) != len(start)
    assert all(bool(value.isfinite().all()) for _, value in scene.items())


def test_what_is_hardly_missed_goes_at_the_end(on_device, photos, target, monkeypatch):
    monkeypatch.setattr("abcd_ns.engine.train.step.final_pruning.LOSS", 0.5)
    options = {"blocks": 2, "steps": 6, "pass_gaussians": 0, "target": target}
    coordinator = on_device(**options, density=DensityConfig())
    told, held = listen(coordinator, PrunedAtEnd), []

    def watched(*given) -> HeldScene:
        scene = HeldScene(*given)
        held.append(weakref.ref(scene))
        return scene

    monkeypatch.setattr("abcd_ns.engine.train.step.final_pruning.HeldScene", watched)
    gc.disable()
    try:
        train(coordinator, photos)
        assert [scene() for scene in held] == [None]  # the device has its memory back at once
    finally:
        gc.enable()
    (found,) = told
    assert found.gone > 0
    assert coordinator.count() == found.gaussians
    assert found.before - found.after <= 0.5


def test_poses_are_refined_by_pictures_of_several_nodes(on_device, views, photos, target, monkeypatch):
    monkeypatch.setattr(pose_rounds, "FIRST", 0.0)
    options = {"blocks": 2, "steps": 6, "poses": "SO3xR3", "pass_gaussians": 1, "target": target}
    coordinator = on_device(**options, light="affine")
    coordinator.poses.take()
    train(coordinator, photos)
    found = [coordinator.views[view.index].viewmat for view in views]
    assert not any(torch.equal(pose, view.viewmat) for pose, view in zip(found, views, strict=True))
    assert bool(torch.stack(found).isfinite().all())


def test_both_rasterizers_train_alike(on_device, make, photos):
    options = {"blocks": 2, "steps": 3, "density": STILL, "ownership": "means"}
    scenes = []
    for coordinator in (on_device("g", **options), on_device("t", "torch", **options), make(**options)):
        train(coordinator, photos)
        scenes.append(whole_scene(coordinator))
    for other in scenes[:2]:
        for name, value in scenes[2].items():
            assert torch.allclose(value, getattr(other, name), atol=2e-3)


def test_a_warm_up_is_trained_and_blocks_that_outgrow_their_limit_are_split(on_device, photos):
    options = {"steps": 14, "density": GROWING, "coarse_model": 100, "warmup": 0.4}
    coordinator = on_device(**options, blocks=2, block_limit=60, sole_limit=60)
    splits = listen(coordinator, BlockSplit)
    train(coordinator, photos)
    assert coordinator.state.step == 14
    assert splits
    assert coordinator.scene.tree.num_blocks == 2 + len(splits)


def test_a_run_is_saved_and_gone_on_with(make, on_device, photos):
    options = {"steps": 11, "density": GROWING, "blocks": 3}
    first = make(**options)
    train(first, photos, steps=2)
    stop(first)
    second = on_device(resume=True, **options)
    assert second.state.step == 2
    train(second, photos, steps=3)
    if second.state.active is not None:
        assert_on_device(second)
    stop(second)
    third = make(resume=True, **options)
    assert third.state.step == 5
    train(third, photos)
    assert third.state.step == 11
