"""Whole trainings by the engine on the simulated device: whatever is on the wrong side raises."""

import gc
import math
import weakref

import pytest
import torch

from abcd_ns.engine.events import BlockSplit, ShedAtEnd, VisitEnded
from abcd_ns.engine.gaussians.block_state import MOMENTS
from abcd_ns.engine.layers.painter import Painter, PaintSettings
from abcd_ns.engine.render import TorchRasterizer
from abcd_ns.engine.render.cuda.backend import GsplatRasterizer
from abcd_ns.engine.store.derived_scenes import HeldScene
from abcd_ns.engine.train.density.control import DensityConfig
from abcd_ns.engine.train.step import pose_rounds
from abcd_ns.engine.train.training_loop import train
from abcd_ns.engine.types import Gaussians
from abcd_ns.peers.exact import ExactTrainer
from abcd_ns.peers.independent import independent_at_rest, independent_trainer
from tests.reference.scenes import listen, make_coordinator, whole_scene
from tests.reference.simulated_device import DEVICE

OFTEN = {"refine_start": 0.0, "refine_stop": 1.0, "refine_every": 3}
GROWING = DensityConfig(**OFTEN, split_pixels=0.0)
MCMC = DensityConfig(**OFTEN, strategy="mcmc", max_gaussians=160)

pytestmark = pytest.mark.usefixtures("simulated_gsplat")


def on_device(folder, start, views, rasterizer="gsplat", **options):
    """A coordinator on the simulated device, with gsplat (without its check) unless told otherwise."""
    draws = TorchRasterizer(use_native=False) if rasterizer == "torch" else GsplatRasterizer()
    return make_coordinator(folder, start, views, device=DEVICE, rasterizer=draws, **options)


def losses_of(scene: Gaussians, views, photos) -> float:
    draw = TorchRasterizer(use_native=False)
    with torch.no_grad():
        pictures = [draw(scene, v, sh_degree=scene.sh_degree).color.clamp(0, 1) for v in views]
    return sum(
        float((p - photos.images[v.index]).square().mean()) for p, v in zip(pictures, views, strict=True)
    )


def assert_on_device(coordinator) -> None:
    """The live block is all there: parameters, moments, and Adam's steps."""
    for name, parameter in coordinator.params.items():
        state = coordinator.optimizers[name].state[parameter]
        assert {parameter.device, *(state[key].device for key in ("step", *MOMENTS))} == {DEVICE}


@pytest.mark.parametrize(
    ("blocks", "density", "layers"),
    [(1, GROWING, True), (1, MCMC, True), (4, GROWING, True), (4, MCMC, True), (4, GROWING, False)],
    ids=["one", "one-mcmc", "four", "four-mcmc", "four-ablated"],
)
def test_blocks_are_trained(tmp_path, start, views, photos, blocks, density, layers):
    steps = 8 if blocks == 1 else 16  # so that something grows
    coordinator = on_device(
        tmp_path, start, views, blocks=blocks, steps=steps, density=density, layers=layers
    )
    train(coordinator, photos, steps=3)
    assert_on_device(coordinator)
    train(coordinator, photos)
    scene = whole_scene(coordinator)
    assert coordinator.state.step == steps
    assert len(scene) != len(start)
    assert all(bool(value.isfinite().all()) for _, value in scene.items())


@pytest.mark.parametrize("together", [0, 1])
def test_what_is_hardly_missed_goes_at_the_end(tmp_path, start, views, photos, monkeypatch, together):
    monkeypatch.setattr("abcd_ns.engine.train.step.last_shedding.LOSS", 0.5)
    target = lambda sample: (photos(sample.view.index, sample.crop).to(DEVICE), None)  # noqa: E731
    options = {"blocks": 2, "steps": 6, "pass_gaussians": together, "target": target}
    coordinator = on_device(tmp_path, start, views, **options, density=DensityConfig())
    told, held = listen(coordinator, ShedAtEnd), []

    class Watched(HeldScene):
        def __init__(self, *given) -> None:
            super().__init__(*given)
            held.append(weakref.ref(self))

    monkeypatch.setattr("abcd_ns.engine.train.step.last_shedding.HeldScene", Watched)
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


def test_a_mask_is_waited_for_once(start, simulated_gsplat):
    there = start.to(DEVICE)
    mask = there.opacities > 0
    before = simulated_gsplat.waited
    assert len(there[mask]) == int((start.opacities > 0).sum())
    assert simulated_gsplat.waited == before + 1


@pytest.mark.parametrize("light", ["exposure", "affine"])
@pytest.mark.parametrize("together", [0, 1])
def test_poses_are_refined_by_pictures_of_one_unit_and_of_several(
    tmp_path, start, views, photos, together, light, monkeypatch
):
    monkeypatch.setattr(pose_rounds, "FIRST", 0.0)
    target = lambda sample: (photos(sample.view.index, sample.crop).to(DEVICE), None)  # noqa: E731
    options = {"blocks": 2, "steps": 6, "poses": "SO3xR3", "pass_gaussians": together, "target": target}
    coordinator = on_device(tmp_path, start, views, **options, light=light)
    coordinator.poses.take()
    train(coordinator, photos)
    moved = [view for view in views if not torch.equal(coordinator.views[view.index].viewmat, view.viewmat)]
    assert len(moved) == len(views)
    assert all(bool(view.viewmat.isfinite().all()) for view in coordinator.views.values())


@pytest.mark.parametrize("ownership", ["means", "fragments"])
def test_the_torch_rasterizer_trains_there_too(tmp_path, start, views, photos, ownership):
    coordinator = on_device(tmp_path, start, views, "torch", blocks=2, steps=2, ownership=ownership)
    train(coordinator, photos)
    assert coordinator.state.step == 2


def test_both_rasterizers_train_alike(tmp_path, start, views, photos):
    """On the device with gsplat, on the device with torch, and on the CPU: the same to rounding."""
    scenes = []
    for name, make in (("gsplat", on_device), ("torch", on_device), (None, make_coordinator)):
        folder = tmp_path / str(name)
        folder.mkdir()
        options = {"rasterizer": name} if name else {}
        options |= {"density": DensityConfig(strategy="off"), "ownership": "means"}
        coordinator = make(folder, start, views, blocks=2, steps=3, **options)
        train(coordinator, photos)
        scenes.append(whole_scene(coordinator))
    for other in scenes[:2]:
        assert all(
            torch.allclose(value, getattr(other, name), atol=2e-3) for name, value in scenes[2].items()
        )


def test_a_warm_up_is_trained(tmp_path, start, views, photos):
    coordinator = on_device(
        tmp_path, start, views, blocks=4, steps=14, density=GROWING, scaffold=100, warmup=0.4
    )
    train(coordinator, photos)
    assert coordinator.state.step == 14


def test_blocks_that_outgrow_their_limit_are_split(tmp_path, start, views, photos):
    coordinator = on_device(
        tmp_path, start, views, blocks=2, steps=14, density=GROWING, block_limit=60, sole_limit=60
    )
    splits = listen(coordinator, BlockSplit)
    train(coordinator, photos)
    assert splits
    assert coordinator.scene.tree.num_blocks == 2 + len(splits)


def test_gaussians_migrate(tmp_path, start, views, photos):
    coordinator = on_device(tmp_path, start, views, blocks=4, steps=12)
    ended = listen(coordinator, VisitEnded)
    while not coordinator.finished:
        train(coordinator, photos, steps=1)
        with torch.no_grad():
            coordinator.params["means"].add_(0.1 * torch.randn_like(coordinator.params["means"]))
    assert sum(event.migrated for event in ended) > 0


def test_what_is_no_number_is_mended(tmp_path, start, views, photos):
    coordinator = on_device(tmp_path, start, views, blocks=2, steps=8, density=GROWING)
    train(coordinator, photos, steps=3)
    with torch.no_grad():
        coordinator.params["scales"][0] = math.nan
        coordinator.params["scales"][1] = 5.0
    train(coordinator, photos)
    assert all(bool(value.isfinite().all()) for _, value in whole_scene(coordinator).items())
    assert sum(record.values for record in coordinator.state.health.values()) > 0


@pytest.mark.parametrize("stop", [2, 5])
def test_a_run_is_saved_and_gone_on_with(tmp_path, start, views, photos, stop):
    """On the CPU, on the device, and on the CPU again."""
    options = {"steps": 11, "density": GROWING, "blocks": 3}
    first = make_coordinator(tmp_path, start, views, **options)
    train(first, photos, steps=stop)
    first.save()
    first.scene.store.close()
    second = on_device(tmp_path, start, views, resume=True, **options)
    assert second.state.step == stop
    train(second, photos, steps=3)
    if second.state.active is not None:
        assert_on_device(second)
    second.save(pin="here")
    second.scene.store.close()
    third = make_coordinator(tmp_path, start, views, resume=True, **options)
    assert third.state.step == stop + 3
    train(third, photos)
    assert third.state.step == 11


@pytest.mark.parametrize("density", [GROWING, MCMC], ids=["default", "mcmc"])
def test_blocks_are_trained_jointly(tmp_path, start, views, photos, density):
    coordinator = on_device(tmp_path, start, views, blocks=3, steps=4, density=density, kind=ExactTrainer)
    before = losses_of(start, views, photos)
    train(coordinator, photos)
    assert losses_of(whole_scene(coordinator), views, photos) < before


def test_blocks_are_trained_apart(tmp_path, start, views, photos):
    options = {
        "kind": independent_trainer,
        "content": independent_at_rest,
        "layers": False,
        "overlap": 0.25,
        "migrate": False,
    }
    coordinator = on_device(tmp_path, start, views, blocks=2, steps=6, density=GROWING, **options)
    train(coordinator, photos)
    assert coordinator.state.step == 6


@pytest.mark.parametrize("rasterizer", ["gsplat", "torch"])
@pytest.mark.parametrize("ownership", ["means", "fragments"])
def test_a_picture_is_composited(tmp_path, start, views, ownership, rasterizer):
    coordinator = on_device(tmp_path, start, views, rasterizer, blocks=4)
    draws = coordinator.run.rasterizer
    painter = Painter(coordinator.scene, views, draws, ownership=ownership, pass_gaussians=0, device=DEVICE)
    layer = painter.picture(views[0], PaintSettings(1, False))
    assert layer.color.device == DEVICE
    if ownership == "fragments":
        merged = TorchRasterizer(use_native=False)(whole_scene(coordinator), views[0], sh_degree=1)
        assert float((layer.color.cpu() - merged.color).abs().max()) < 5e-4
