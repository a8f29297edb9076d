"""When a block grows, by its own clock and by the run's, and how."""

import math
from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from abcd_ns.engine.gaussians.block_state import BlockState, Clocks
from abcd_ns.engine.train.density import control as control_module
from abcd_ns.engine.train.density.control import (
    LEAST_REFINEMENTS,
    USUAL_REFINEMENTS,
    DensityClock,
    DensityConfig,
    DensityControl,
)
from abcd_ns.engine.train.density.growing import WORTH
from abcd_ns.engine.types import PARAM_NAMES
from tests.reference.scenes import activated, random_gaussians

VIEWS = 5


def statistics(*gains: float) -> dict[str, torch.Tensor]:
    """By which a split of each along its middle axis removes so much squared error, where a pixel has 1."""
    found = torch.zeros(len(gains), 27)
    for half in (0, 12):
        found[:, half + 3] = (torch.tensor(gains) / VIEWS / 2).sqrt()
        found[:, half + 9 : half + 12] = 1.0
    found[:, 24:] = 1.0
    return {WORTH: found}


def clock(**changes) -> DensityClock:
    given = {"progress": 0.2, "steps": 100, "taken": 1, "views": VIEWS, "room": None}
    return DensityClock(**{**given, **changes})


def test_the_default_strategy_splits_what_is_worth_it(monkeypatch):
    monkeypatch.setattr(control_module, "MOST_NEW", 1.0)
    gaussians = random_gaussians(8, size=0.001)
    params, optimizers = activated(gaussians)
    control = DensityControl(DensityConfig(split_pixels=6.0, cull_alpha_thresh=0.0))
    growth = statistics(*[7.0] * 5, *[5.0] * 3)
    growth, refined = control.after_step(params, optimizers, growth, clock())
    assert refined
    assert len(params["means"]) == 13
    assert not bool(growth[WORTH].any())
    assert growth[WORTH].shape == (13, 27)
    assert all(len(optimizers[n].param_groups[0]["params"][0]) == 13 for n in PARAM_NAMES)
    narrower = params["scales"].detach()[3:8] < gaussians.scales[:5] - 0.1
    assert narrower.tolist() == [[False, True, False]] * 5


@pytest.mark.parametrize(("room", "added"), [(None, 30), (200, 30), (12, 12), (0, 0)])
def test_a_refinement_adds_at_most_a_tenth_best_first(room, added):
    params, optimizers = activated(random_gaussians(300, size=0.001))
    control = DensityControl(DensityConfig(cull_alpha_thresh=0.0))
    before = params["means"].detach().clone()
    given = statistics(*range(100, 400)), clock(room=room)
    control.after_step(params, optimizers, *given)
    assert len(params["means"]) == 300 + added
    assert torch.equal(params["means"][: 300 - added], before[: 300 - added])  # the best are the last


def test_a_block_among_others_may_add_a_tenth_for_each_refinement_that_it_went_without():
    """In its first visit twice as many; where a picture shows half as much as usual, half as many."""
    control = DensityControl(DensityConfig(refine_every=50))

    def most(drawn: int, **changes) -> float:
        return control.most_new(clock(steps=1000, refined=1000 - drawn, **{"visit": 80, **changes}), 1.0)

    shares = [most(150, visit=None), most(10), most(50), most(100), most(100, first=True), most(5000)]
    assert shares == pytest.approx([0.1, 0.1, 0.1, 0.21, 1.1**4 - 1, 1.0])
    usual, at = DensityControl(DensityConfig()), clock(steps=1000, progress=0.1, refined=800, visit=80)
    assert [usual.most_new(at, seen) for seen in (0.8, 0.2)] == pytest.approx([0.21, 0.1])


def test_without_room_nothing_is_added_but_the_transparent_go_and_the_large_stay():
    """Sky and far background are large; what is so for every camera is held back by angle."""
    gaussians = random_gaussians(8, size=0.001)
    gaussians.opacities[:] = 2.0
    gaussians.opacities[:3] = -8.0
    gaussians.scales[5] = math.log(5.0)
    params, optimizers = activated(gaussians)
    control = DensityControl(DensityConfig())
    control.after_step(params, optimizers, statistics(*[99.0] * 8), clock(room=0))
    assert torch.equal(params["means"], gaussians.means[3:])


def test_clocks_of_older_versions_are_read():
    meta = {"clocks": {**vars(Clocks(steps=2, visits=1)), "resets": 3}}
    assert BlockState.clocks_of(meta) == Clocks(steps=2, visits=1)


def refinements(run: int, views: int, taken: int = 1, **changes) -> list[int]:
    """Views after which a run that draws so many is refined."""
    control, found = DensityControl(DensityConfig(**changes)), [0]
    for steps in range(taken, run + 1, taken):
        at = clock(steps=steps, progress=steps / run, views=views, taken=taken, refined=found[-1])
        found += [steps] if control.is_due(at) else []
    return found[1:]


@given(st.integers(400, 30_000), st.integers(1, 15_000), st.integers(1, 4))
@settings(max_examples=20, deadline=None)
def test_every_run_is_refined_about_4_to_150_times_and_20_where_all_views_were_drawn(run, views, taken):
    found = refinements(run, views, taken)
    assert LEAST_REFINEMENTS - 1 <= len(found) <= 150
    all_views_drawn = (0.5 - 1 / 60) * run / views
    assert len(found) >= 0.7 * min(USUAL_REFINEMENTS, all_views_drawn) - 1


@pytest.mark.parametrize(
    ("run", "views", "given", "expected"),
    [(7000, 147, 0, 147), (30_000, 700, 0, 700), (3000, 20, 100, 100), (3000, 130, 100, 130)],
)
def test_a_block_is_refined_whenever_its_views_or_as_many_as_given_were_drawn(run, views, given, expected):
    found = refinements(run, views, refine_every=given)
    assert {b - a for a, b in pairwise(found)} == {expected}


@pytest.mark.parametrize(("progress", "expected"), [(0.0, False), (0.1, True), (0.49, True), (0.5, False)])
def test_refinement_keeps_to_its_share_of_the_run(progress, expected):
    assert DensityControl(DensityConfig()).is_due(clock(progress=progress)) is expected


@pytest.mark.parametrize("steps", [17, 32, 39, 64])
def test_a_first_visit_grows_though_its_views_are_drawn_about_once(steps):
    """It was refined in the warm-up, just now perhaps; later visits count from the one before."""
    control, batch = DensityControl(DensityConfig()), 4

    def is_ever_due(first: bool) -> bool:
        given = {"refined": 1000, "taken": batch, "views": batch * steps, "visit": batch * steps}
        clocks = (clock(steps=1000 + batch * k, spent=k / steps, **given) for k in range(1, steps + 1))
        return any(control.is_due(replace(at, first=first)) for at in clocks)

    assert is_ever_due(first=True)
    assert not is_ever_due(first=False)


def test_a_block_among_others_refines_early_in_its_visits_and_makes_up_for_what_it_missed():
    control = DensityControl(DensityConfig(refine_every=30))
    at = clock(views=20, taken=4, refined=100, spent=0.1)
    assert not control.is_due(replace(at, steps=128))
    assert control.is_due(replace(at, steps=132))
    assert not control.is_due(replace(at, steps=132, spent=0.6))
    assert control.is_due(replace(at, steps=190))  # overdue: no multiple of 30 is here
    assert not control.is_due(replace(at, steps=19, refined=0, views=40))


def test_a_block_grows_in_its_first_visit_unless_that_is_in_the_last_third():
    late = clock(progress=0.6, refined=0, spent=0.1, first=True)
    control = DensityControl(DensityConfig())
    assert control.is_due(late)
    for changes in ({"progress": 0.71}, {"first": False}, {"spent": 0.6}):
        assert not control.is_due(replace(late, **changes))
    assert not DensityControl(DensityConfig(refine_start=1.0, refine_stop=0.0)).is_due(late)


def test_a_block_is_refined_less_often_where_a_picture_shows_little_of_it():
    """As often for each Gaussian; but no less than four times in a run, and never where a number is given."""

    def every(seen: float, run: int = 20_000, **changes) -> int:
        taken, control = range(1000, run), DensityControl(DensityConfig(**changes))
        at = (clock(steps=n, progress=n / run, refined=999, views=5) for n in taken)
        return next(each.steps - each.refined for each in at if control.is_due(each, seen))

    assert [every(seen) for seen in (1.0, 0.4, 0.2, 0.1)] == [100, 100, 200, 400]
    assert every(0.1, refine_every=30) == 30
    assert every(0.001) == every(0.0) == int((0.5 - 1 / 60) * 20_000 / LEAST_REFINEMENTS)
