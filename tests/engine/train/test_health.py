"""What goes wrong while a block is trained is noticed, logged and repaired; what is healthy is left alone."""

import math
from dataclasses import replace

import pytest
import torch

from abcd_ns.engine.events import Repaired, VisitBegan
from abcd_ns.engine.gaussians.param_swap import attach
from abcd_ns.engine.train.density.control import DensityConfig, DensityControl
from abcd_ns.engine.train.health import OVERSIZED_ANGLE, unsound
from abcd_ns.engine.train.memory import ACTIVE_COPIES, OutOfRoomError, check_room, parameter_bytes
from abcd_ns.engine.train.step.active_block import LARGEST
from abcd_ns.engine.train.training_loop import train, train_step
from abcd_ns.engine.types import PARAM_NAMES
from tests.reference.scenes import (
    STILL,
    UNPRUNED,
    listen,
    random_gaussians,
    spoil_gradients,
    stop,
    whole_scene,
)


@pytest.mark.parametrize(("value", "blocks"), [(math.nan, 3), (1e30, 1)])
def test_gradients_that_are_no_numbers_are_set_to_zero_and_counted(make, photos, value, blocks):
    coordinator = make(blocks=blocks, steps=12, density=UNPRUNED)
    told = listen(coordinator, Repaired)
    spoil_gradients(coordinator, "scales", 2, value)
    train(coordinator, photos)
    assert {event.what for event in told} == {"gradients"}
    assert sum(event.count for event in told) == 12
    assert sum(record.gradients for record in coordinator.state.health.values()) == 12
    for block in range(blocks):
        tensors, _ = coordinator.scene.state(block).packed()
        assert all(bool(torch.isfinite(tensor).all()) for tensor in tensors.values())


def test_a_value_that_is_no_number_is_put_back_and_a_moment_set_to_zero(make, photos):
    coordinator = make(blocks=2, steps=30, density=STILL)
    train_step(coordinator, photos)
    block = coordinator.state.active.geometry.block
    before, told = coordinator.scene.stored_with_pending(block), listen(coordinator, Repaired)
    coordinator.params["means"].detach()[4, 1] = math.nan
    coordinator.optimizers["means"].state[coordinator.params["means"]]["exp_avg"][4] = 7.0
    squares = coordinator.optimizers["quats"].state[coordinator.params["quats"]]["exp_avg_sq"]
    kept = squares[1].clone()
    squares[0] = math.inf
    coordinator.save()
    repaired = sorted((event.what, event.count, event.block) for event in told)
    assert repaired == [("moments", 1, block), ("values", 1, block)]
    assert bool((squares[0] == 0).all())
    assert torch.equal(squares[1], kept)
    after = coordinator.scene.gaussians(block)
    assert all(torch.equal(value[4], getattr(before, name)[4]) for name, value in after.items())
    moments = coordinator.optimizers["means"].state[coordinator.params["means"]]["exp_avg"]
    assert bool((moments[4] == 0).all())
    assert bool((moments[5] != 0).any())


def test_where_rows_have_changed_a_transparent_one_takes_its_place(make, photos):
    coordinator = make(blocks=2, steps=200, density=UNPRUNED)
    attached = listen(coordinator, VisitBegan)
    while not attached or len(coordinator.params["means"]) == attached[-1].gaussians:
        train_step(coordinator, photos)
    coordinator.params["scales"].detach()[0] = 100.0
    coordinator.save()
    assert bool(torch.isfinite(coordinator.params["scales"]).all())
    assert float(torch.sigmoid(coordinator.params["opacities"].detach()[0])) < 1 / 255


def test_oversized_gaussians_shrink_to_what_the_nearest_camera_sees_of_them(make, views, photos):
    coordinator = make(blocks=2, steps=30)
    train_step(coordinator, photos)
    means, scales = coordinator.params["means"].detach(), coordinator.params["scales"].detach()
    scales[0] = torch.tensor([5.0, -3.0, 5.0])
    means[1], scales[1] = torch.tensor([500.0, 0.0, 0.0]), math.log(100.0)
    scales[2] = 5.0  # spared
    told, kept = listen(coordinator, Repaired), scales[2:].clone()
    coordinator.health.shrink_oversized(views, torch.arange(len(scales)) == 2)
    assert [(event.what, event.count) for event in told] == [("oversized", 1)]
    nearest = min(float((means[0] - view.center).norm()) for view in views)
    limit = OVERSIZED_ANGLE * nearest
    assert scales[0].tolist() == pytest.approx([math.log(limit), -3.0, math.log(limit)])
    assert float(scales[1].max()) == pytest.approx(math.log(100.0))
    assert torch.equal(scales[2:], kept)


@pytest.mark.parametrize("blocks", [1, 2])
def test_oversized_gaussians_shrink_before_their_block_is_trained_and_none_grows_later(
    make, views, photos, start, blocks
):
    start.scales[0] = 5.0
    coordinator = make(blocks=blocks, steps=20, warmup=0.0, density=STILL)
    told = listen(coordinator, Repaired)
    train(coordinator, photos, steps=18)
    assert {event.what for event in told} == {"oversized"}
    told.clear()
    coordinator.params["scales"].detach()[1] = 5.0
    train(coordinator, photos)
    scene = whole_scene(coordinator)
    nearest = torch.cdist(scene.means, torch.stack([view.center for view in views])).amin(dim=1)
    assert float((scene.scales.amax(dim=1).exp() / nearest).max()) <= 1.25 * OVERSIZED_ANGLE
    assert not told
    assert all(LARGEST not in coordinator.scene.state(block).growth for block in range(blocks))


def test_what_fills_much_of_its_views_may_be_oversized(make, views, photos):
    """A wall of one colour may be one oversized Gaussian."""
    coordinator = make(blocks=1, steps=40, warmup=0.0, density=STILL)
    train(coordinator, photos, steps=12)
    block = coordinator.visit.block
    block.growth = {"weight": torch.zeros(len(block)), "passes": torch.ones(len(block))}
    block.growth["weight"][0] = 0.02 * sum(view.full.pixels for view in views)
    for scale in (5.0, 6.0):
        coordinator.params["scales"].detach()[:2] = scale
        train_step(coordinator, photos)
    assert coordinator.params["scales"][:2].amax(dim=1).tolist() == pytest.approx([6.0, 5.0], abs=0.1)


def test_every_parameter_is_looked_at():
    for name in PARAM_NAMES:
        gaussians = random_gaussians(5)
        getattr(gaussians, name)[3].view(-1)[-1] = math.nan
        assert unsound(gaussians).tolist() == [False, False, False, True, False], name


def test_a_block_that_cannot_fit_is_refused_before_memory_is_taken(make, photos, monkeypatch):
    with pytest.raises(OutOfRoomError, match=r"1,000,000,000,000 Gaussians .*max-gaussians"):
        check_room(10**12, 3, torch.device("cpu"))
    check_room(1000, 3, torch.device("cpu"))
    free = 30 * ACTIVE_COPIES * parameter_bytes(1)
    monkeypatch.setattr("abcd_ns.engine.train.memory.free_bytes", lambda _: free)
    coordinator = make(blocks=2, steps=10)
    with pytest.raises(OutOfRoomError, match="A block of 60 Gaussians"):
        train_step(coordinator, photos)


@pytest.mark.parametrize("blocks", [1, 3])
def test_a_block_that_is_emptied_in_its_visit_ends_it(make, photos, blocks):
    """All its Gaussians may be pruned; the run goes on, and can be resumed."""
    options = {"blocks": blocks, "steps": 30, "density": DensityConfig(refine_start=0.0)}
    coordinator = make(**options)
    train(coordinator, photos, steps=2)
    block = coordinator.visit.block
    attach(block.detached()[:0], coordinator.params, coordinator.optimizers, batch=coordinator.batch)
    block.growth = {}
    batch = coordinator.next_batch()
    wanted = [photos(sample.view.index, sample.crop) for sample in batch.samples]
    assert coordinator.loss(batch, coordinator.render(batch).pictures, wanted).requires_grad
    train(coordinator, photos, steps=2)
    assert coordinator.state.active is not None
    stop(coordinator)
    resumed = make(resume=True, **options)
    left = resumed.state.active.steps - resumed.state.active.done
    train(resumed, photos, steps=left)
    assert resumed.state.active is None
    assert resumed.count() == coordinator.count()


def test_a_visit_that_time_ran_out_on_says_nothing_of_whether_the_block_is_hidden(make):
    coordinator = make(blocks=3, warmup=0.0)
    coordinator.next_batch()
    block = coordinator.state.active.geometry.block
    coordinator.end_visit()
    assert coordinator.state.step == 0
    assert coordinator.state.health[block].visits == 1
    assert not coordinator.state.health[block].hidden


def test_a_value_that_is_no_number_bounds_nothing(make, views, photos):
    coordinator = make(blocks=1, steps=30, density=STILL)
    train_step(coordinator, photos)
    coordinator.params["means"].detach()[0] = coordinator.params["scales"].detach()[1] = math.nan
    nobody = torch.zeros(len(coordinator.params["means"]), dtype=torch.bool)
    largest = coordinator.health.largest(views, nobody)
    assert bool((largest[:2] > 40).all())


@pytest.mark.parametrize(("seen", "expected"), [(3, 3), (3000, 40)])
def test_blocks_are_refined_once_a_visit_however_many_views_there_are(make, photos, seen, expected):
    coordinator = make(blocks=2, steps=200, visit_steps=10)
    train_step(coordinator, photos)
    coordinator.state.active.showing = tuple(range(seen))
    clock = coordinator.visit.block.density_clock(4, coordinator.batch, None)
    assert (clock.views, min(clock.views, clock.visit)) == (seen, expected)
    control = DensityControl(DensityConfig(refine_every=1))
    due = replace(clock, progress=0.02, refined=0, first=False)
    assert control.is_due(replace(due, steps=expected))
    assert not control.is_due(replace(due, steps=expected - 1))
