"""What a step on a device waits for and copies, and what it tells a step late."""

import math

import pytest
import torch

from abcd_ns.engine.events import Repaired, StepTaken
from abcd_ns.engine.gaussians import param_swap
from abcd_ns.engine.gaussians.param_swap import PARAM_NAMES
from abcd_ns.engine.render.cuda.backend import GsplatRasterizer
from abcd_ns.engine.train.density.control import DensityConfig
from abcd_ns.engine.train.density.degrees import lowered
from abcd_ns.engine.train.density.pruning import BLEND_SUMS
from abcd_ns.engine.train.health import LATE_AFTER, widest
from abcd_ns.engine.train.training_loop import train, train_step
from abcd_ns.engine.types import Crop
from tests.reference.rasterizer_scenes import as_leaves
from tests.reference.scenes import (
    STILL,
    listen,
    random_gaussians,
    ring_of_views,
    spoil_gradients,
    whole_scene,
)
from tests.reference.simulated_device import DEVICE

GATHERING = DensityConfig(refine_start=1.0, refine_stop=1.0)


@pytest.mark.parametrize("parts", [0, 300])
def test_a_step_waits_once_and_copies_its_photos_alone(on_device, photos, simulated_gsplat, parts):
    """Beside what isect_tiles waits for, which gives a list whose length nobody knows."""
    coordinator, counted = on_device(blocks=4, steps=24, density=GATHERING, crop_pixels=parts), []
    while not coordinator.finished:
        active, before = coordinator.state.active, simulated_gsplat.copy()
        train_step(coordinator, photos)
        if active is not None and coordinator.state.active is active:  # no visit began or ended
            counted.append(simulated_gsplat.since(before))
    assert len(counted) > 8
    for taken in counted:
        apart = taken.waits.pop("isect_tiles")
        assert apart == 1
        assert dict(+taken.waits) in ({}, {"event": 1})
        assert taken.copies_to_device in (coordinator.batch, 2 * coordinator.batch)  # photos, and cameras
        assert taken.copies_to_host == 1
        assert taken.bytes_to_host < 100


@pytest.mark.parametrize("crop", [None, Crop(16, 0, 20, 20)])
def test_a_drawing_leaves_nothing_behind(start, views, simulated_gsplat, crop):
    rasterizer, live = GsplatRasterizer(), []
    leaves = as_leaves(start.to(DEVICE))
    for _ in range(3):
        raster = rasterizer(leaves, views[0], sh_degree=1, crop=crop, residual_sums=True)
        raster.info["sums"].ask([torch.ones(*raster.depth.shape, 4, device=DEVICE)])
        raster.color.sum().backward()
        assert bool(raster.info["sums"].values.any())
        del raster
        live.append(simulated_gsplat.live_bytes)
    assert live[1] == live[2]


@pytest.mark.parametrize("views", [3, 12])
def test_rules_of_a_refinement_copy_cameras_once_however_many_there_are(counts, views):
    gaussians, ring = random_gaussians(5).to(DEVICE), ring_of_views(views)
    growth = {name: torch.ones(5).to(DEVICE) for name in BLEND_SUMS}
    before = counts.copy()
    widest(gaussians.means, ring)
    assert counts.since(before).copies_to_device == 1
    before = counts.copy()
    lowered(gaussians, growth, ring, gaussians.sh_degree)
    assert counts.since(before).copies_to_device == 1


def test_no_more_ram_is_pinned_for_a_block_than_there_is_for_that(counts, monkeypatch):
    """Four of 4,000 bytes take 4,096 each, and the last is always waited for."""
    values = [torch.full((1000,), float(k), device=DEVICE) for k in range(4)]
    waits = []
    for room in (0, 8192, 1 << 20):
        monkeypatch.setattr(param_swap, "PINNED_BYTES", room)
        before = counts.copy()
        copies = param_swap._on_cpu(values)
        waits.append(counts.since(before).waited)
        assert all(bool((copy == k).all()) for k, copy in enumerate(copies))
    assert waits == [4, 2, 1]


def test_listeners_hear_of_a_step_when_the_next_is_taken(make, on_device, photos):
    heard = []
    for name, made in (("cpu", make), ("device", on_device)):
        coordinator = made(name, blocks=2, steps=6, density=STILL, ownership="means")
        heard.append(listen(coordinator, StepTaken))
        train(coordinator, photos)
        assert coordinator.state.health
    now, late = heard
    assert [event.visit_step for event in now] == [event.visit_step for event in late]
    for k, event in enumerate(late):
        if event.visit_step == 1:
            assert math.isnan(event.psnr)
        else:
            assert event.psnr == pytest.approx(now[k - 1].psnr, abs=1e-3)


def values(coordinator) -> dict[str, torch.Tensor]:
    return {name: coordinator.params[name].detach().cpu() for name in PARAM_NAMES}


def test_a_step_whose_gradients_are_no_numbers_is_skipped(on_device, photos):
    coordinator = on_device(blocks=1, steps=12, density=GATHERING)
    told = listen(coordinator, Repaired)
    for step in (3, 6):
        spoil_gradients(coordinator, "means", 2, math.nan, at=step)
    train(coordinator, photos, steps=3)
    before = values(coordinator)
    adam = coordinator.optimizers["means"].state[coordinator.params["means"]]
    clock = float(adam["step"])
    train_step(coordinator, photos)
    assert all(torch.equal(before[name], value) for name, value in values(coordinator).items())
    assert float(adam["step"]) == clock
    assert told == []  # nobody knows yet
    train_step(coordinator, photos)
    assert not torch.equal(before["means"], values(coordinator)["means"])
    assert [(event.what, event.count) for event in told] == [("gradients", 1)]
    # From then on one row is cleaned, and the others are trained.
    train_step(coordinator, photos)
    before = values(coordinator)
    train_step(coordinator, photos)
    assert not torch.equal(before["means"], values(coordinator)["means"])
    assert [(event.what, event.count) for event in told] == [("gradients", 1)] * 2
    train(coordinator, photos, steps=4)
    assert bool(coordinator.visit.block.growth["worth"].isfinite().all())
    train(coordinator, photos)
    assert all(bool(value.isfinite().all()) for _, value in whole_scene(coordinator).items())


def test_a_step_waits_as_before_some_steps_after_one_that_was_skipped(on_device, photos, simulated_gsplat):
    """Rows are looked at one by one for a while, and steps that six optimizers count once are counted on."""
    options = {"density": GATHERING, "commit_seconds": 3600.0}  # a commit waits, too
    coordinator = on_device(blocks=1, steps=LATE_AFTER + 12, **options)
    spoil_gradients(coordinator, "means", 2, math.nan, at=3)
    waits = []
    for _ in range(LATE_AFTER + 10):
        before = simulated_gsplat.copy()
        train_step(coordinator, photos)
        waits.append(simulated_gsplat.since(before).waited)
    assert min(waits[5 : 4 + LATE_AFTER]) > 2
    assert set(waits[-4:]) == {2}
    steps = [o.state[coordinator.params[name]]["step"] for name, o in coordinator.optimizers.items()]
    assert {float(step) for step in steps} == {LATE_AFTER + 9.0}
