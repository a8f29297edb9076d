"""What an epoch visits and how: ahead, at first, at the end; and the paper's choices, each an option."""

from collections import Counter
from dataclasses import replace

import pytest
import torch
from torch.testing import assert_close

from abcd_ns.engine.events import EpochEnded, PhotosWanted, VisitBegan
from abcd_ns.engine.render.loss import photometric_loss
from abcd_ns.engine.train.planner import LOOK_AGAIN
from abcd_ns.engine.train.run_state import BlockHealth, Budget, Stopwatch
from abcd_ns.engine.train.schedule import plan_epoch, views_per_step
from abcd_ns.engine.train.step.batch import COMING
from abcd_ns.engine.train.training_loop import train, train_step
from tests.reference.scenes import STILL, UNPRUNED, assert_resumes, listen, steps_of, stop


def narrow(views):
    """One more view, which sees a thirtieth of what the first sees in each direction."""
    zoom = torch.tensor([[30.0, 1.0, 1.0], [1.0, 30.0, 1.0], [1.0, 1.0, 1.0]])
    return replace(views[0], index=len(views), K=views[0].K * zoom)


def test_who_is_hidden_is_no_part_of_an_epoch_until_looked_at_again(make, photos):
    coordinator = make(blocks=4, steps=10_000, density=STILL)
    ended, began = listen(coordinator, EpochEnded), listen(coordinator, VisitBegan)
    while not ended:
        train_step(coordinator, photos)
    for epoch in range(1, 5):
        coordinator.state.health = {block: BlockHealth(hidden=block > 0) for block in range(4)}
        while ended[-1].epoch < epoch:
            train_step(coordinator, photos)
        expected = {0} if epoch % LOOK_AGAIN else {0, 1, 2, 3}
        assert {visit.block for visit in began if visit.epoch == epoch} == expected


@pytest.mark.parametrize("many", [100, 0])
def test_views_that_see_nothing_of_a_block_are_not_used_though_they_look_at_it(
    make, start, views, monkeypatch, many
):
    monkeypatch.setattr("abcd_ns.engine.train.planner.MANY", many)
    # To both sides of a gap that the narrow view looks into.
    apart = start.means + torch.where(start.means[:, 1:2] > 0, 1.0, -1.0) * torch.tensor([0.0, 2.0, 0.0])
    start = replace(start, means=apart * torch.tensor([20.0, 1.0, 1.0]))
    coordinator = make(blocks=2, start=start, views=[*views, narrow(views)], warmup=0.0)
    coordinator.next_batch()
    assert set(coordinator.state.active.views) <= {view.index for view in views}
    assert (len(views) in coordinator.state.active.trained_on) == (many == 0)


def test_one_block_is_trained_on_all_views_however_little_each_sees(make, views, monkeypatch):
    monkeypatch.setattr("abcd_ns.engine.train.planner.MANY", 0)
    coordinator = make(blocks=1, views=[*views, narrow(views)])
    coordinator.next_batch()
    assert set(coordinator.state.active.views) == set(range(len(views) + 1))


def test_photos_of_a_step_and_of_those_to_come_are_wanted(make):
    coordinator = make(blocks=4, steps=24)
    wanted = listen(coordinator, PhotosWanted)
    told: dict[int, list[tuple[int, ...]]] = {}
    drawn: dict[int, list[int]] = {}
    while not coordinator.finished:
        batch = coordinator.next_batch()
        visit = coordinator.run.active.number
        told.setdefault(visit, []).append(wanted[-1].views)
        drawn.setdefault(visit, []).extend(sample.view.index for sample in batch.samples)
        coordinator.after_step(coordinator.render(batch))
    for visit, order in drawn.items():
        for step, views_told in enumerate(told[visit]):
            follows = order[step * coordinator.batch :][: coordinator.batch + COMING]
            assert list(views_told[: len(follows)]) == follows
    assert any(len(views_told) > coordinator.batch for views_told in told[0])


def test_a_block_draws_more_views_a_step_as_it_grows_up_also_when_it_goes_on(make, monkeypatch):
    monkeypatch.setattr("abcd_ns.engine.train.schedule.UNDER_TRAINED", 20)  # these see a few dozen
    options = {"blocks": 3, "steps": 150, "fast_start": True, "density": STILL}
    coordinator, drawn, expected, stops = make(**options), set(), 0, 0
    while not coordinator.finished:
        batch = coordinator.next_batch()
        active = coordinator.run.active
        if active.done == 0:
            expected = views_per_step(0, 3, trained=coordinator.visit.block.clocks.adam_views)
        assert len(batch.samples) == coordinator.batch == expected
        drawn.add(expected)
        coordinator.after_step(coordinator.render(batch))
        if active.done == 1 and expected == 2:  # in the midst of a visit
            stop(coordinator)
            coordinator, stops = make(resume=True, **options), stops + 1
    assert drawn == {1, 2, 4}
    assert stops > 0


@pytest.mark.parametrize("limit", ["steps", "seconds"])
@pytest.mark.parametrize(("left", "epochs"), [(3, 1), (26, 1), (45, 1), (58, 1), (62, 2), (95, 2), (110, 3)])
def test_blocks_share_what_a_limit_leaves_for_the_last_epoch(make, photos, limit, left, epochs):
    coordinator = make(blocks=4, visit_steps=10, batch=1, warmup=0.0, density=STILL)
    coordinator.run.budget = Budget(**{limit: left})
    coordinator.run.stopwatch = Stopwatch(clock=lambda: float(coordinator.state.step))  # a second each
    began = listen(coordinator, VisitBegan)
    train(coordinator, photos)
    assert coordinator.state.step == left
    if left > 4 * 4:
        assert Counter(visit.block for visit in began) == dict.fromkeys(range(4), epochs)
    # How long a step takes is known after the first visit.
    last = [visit.steps for visit in began[limit == "seconds" :] if visit.epoch == epochs - 1]
    assert max(last, default=0) - min(last, default=0) <= 1


def test_the_last_epoch_shares_views_also_where_steps_draw_different_numbers(make, photos, monkeypatch):
    def mixed(epoch, views, passes, seed, each, batches):
        return plan_epoch(epoch, views, passes, seed, each, {block: 1 + block % 2 for block in batches})

    monkeypatch.setattr("abcd_ns.engine.train.schedule.plan_epoch", mixed)
    coordinator = make(blocks=4, steps=140, warmup=0.0, density=STILL)
    began = listen(coordinator, VisitBegan)
    train(coordinator, photos)
    last = max(visit.epoch for visit in began)
    shares = {v.block: v.steps * (1 + v.block % 2) / v.views for v in began if v.epoch == last}
    assert (coordinator.state.step, len(shares)) == (140, 4)
    assert max(shares.values()) - min(shares.values()) <= 2 / 5
    assert min(shares.values()) > 4  # of the usual epochs


def test_views_that_are_drawn_one_after_the_other_train_the_same(make, photos):
    options = {"blocks": 3, "steps": 40, "batch": 4, "light": "affine"}
    together, apart = make("together", **options), make("apart", batch_limit=3, **options)
    assert sorted(len(part.samples) for part in apart.next_batch().parts()) == [1, 3]
    for coordinator in (together, apart):
        train(coordinator, photos, steps=12)
    assert len(together.params["means"]) == len(apart.params["means"])
    for name, value in together.params.items():
        assert_close(apart.params[name], value, rtol=1e-3, atol=1e-4)
    for name, value in together.visit.block.growth.items():
        assert_close(apart.visit.block.growth[name], value, rtol=1e-3, atol=1e-3)


def test_rates_fall_at_the_end_but_not_in_the_first_visit_to_a_block(make, photos, monkeypatch):
    monkeypatch.setattr("abcd_ns.engine.train.schedule.DECAY_VIEWS", 1)  # these see a few dozen
    coordinator = make(blocks=7, steps=55, density=STILL, visit_steps=5, fast_start=True)
    began, rates = listen(coordinator, VisitBegan), dict[int, set[float]]()
    for _ in steps_of(coordinator, photos):
        rates.setdefault(began[-1].visit, set()).add(coordinator.optimizers["quats"].param_groups[0]["lr"])
    first, second = [rates[visit.visit] for visit in began[:7]], [rates[visit.visit] for visit in began[7:]]
    assert sorted(visit.block for visit in began[:7]) == list(range(7))
    # As large as they ever are, though the first epoch goes on when three fifths of the run are done.
    (whole,) = set.union(*first)
    assert max(set.union(*second)) < whole
    assert min(second[-1]) < 0.2 * whole


def test_a_run_whose_growth_is_over_grows_in_the_first_visit_to_each_block(make, photos):
    density = replace(UNPRUNED, refine_stop=0.01, refine_every=1)
    coordinator = make(blocks=2, steps=60, coarse_model=40, visit_steps=8, density=density)
    counts: dict[bool, dict[int, set[int]]] = {True: {}, False: {}}
    for _ in steps_of(coordinator, photos):
        active, block = coordinator.state.active, coordinator.visit.block
        if active is not None and not active.is_whole:
            counts[block.clocks.visits == 0].setdefault(active.geometry.block, set()).add(len(block))
    assert [len(found) for found in counts[True].values()] == [2, 2]  # before it grew, and after
    assert [len(found) for found in counts[False].values()] == [1, 1]


@pytest.mark.parametrize("keep", [True, False])
def test_moments_are_forgotten_at_the_next_visit_only_when_asked(make, photos, keep):
    coordinator = make(blocks=2, steps=30, visit_steps=3, batch=1, density=STILL, keep_moments=keep)
    train(coordinator, photos, steps=6)
    coordinator.next_batch()
    assert coordinator.scene.clocks(coordinator.state.active.geometry.block).adam_views == 3
    adam = coordinator.optimizers["scales"].state[coordinator.params["scales"]]
    assert int(adam["step"]) == (3 if keep else 0)
    assert bool(adam["exp_avg"].any()) == keep
    assert coordinator.visit.block.clocks.visits == 1


def test_a_run_without_moments_can_be_resumed_within_a_visit(make, photos):
    options = {"visit_steps": 4, "batch": 1, "keep_moments": False, "sh_restart": True, "migrate": False}
    assert_resumes(make, photos, 10, blocks=2, steps=16, density=STILL, **options)


def test_the_degree_begins_at_0_in_every_visit_and_layers_have_the_highest(make, photos):
    options = {"visit_steps": 4, "batch": 1, "sh_restart": True, "sh_ramp": 0.5}
    coordinator, degrees = make(blocks=2, steps=16, **options), []
    while not coordinator.finished:
        coordinator.next_batch()
        degrees.append(coordinator.run.sh_degree)
        assert coordinator.state.active.sh_degree == 1
        train_step(coordinator, photos)
    assert degrees == [0, 0, 1, 1] * 4


def test_leavers_are_deleted_when_asked(make, photos):
    """Else they migrate: test_coordinator."""
    coordinator = make(blocks=2, steps=8, visit_steps=4, batch=1, density=STILL, migrate=False)
    train(coordinator, photos, steps=3)
    block = coordinator.state.active.geometry.block
    coordinator.params["means"].detach()[:5] = coordinator.scene.gaussians(1 - block).means[:5]
    train(coordinator, photos, steps=1)
    assert coordinator.count() == 115
    means = coordinator.scene.gaussians(block).means
    assert bool((coordinator.scene.tree.assign(means) == block).all())


@pytest.mark.parametrize("ssim_lambda", [0.0, 0.2])
def test_l2_is_the_mean_squared_difference(ssim_lambda):
    generator = torch.Generator().manual_seed(0)
    rendered, photo = (torch.rand(20, 30, 3, generator=generator, dtype=torch.float64) for _ in range(2))
    sizes = {"full_pixels": 600, "full_windows": 200, "ssim_lambda": ssim_lambda}
    apart = rendered.requires_grad_() - photo
    expected = (1 - ssim_lambda) * (apart.square().mean() - apart.abs().mean())
    l1, l2 = (photometric_loss(rendered, photo, pixel_loss=kind, **sizes) for kind in ("l1", "l2"))
    assert_close(l2 - l1, expected, rtol=1e-9, atol=0.0)
    (found,), (wanted,) = (torch.autograd.grad(loss, rendered) for loss in (l2 - l1, expected))
    assert_close(found, wanted, rtol=1e-9, atol=1e-12)
