"""When a block grows: by its own clock, and by the run's."""

import math
from itertools import pairwise

import pytest

from abcd_ns.engine.train.density.clock import DensityClock
from abcd_ns.engine.train.density.control import DensityConfig, DensityControl


def clock(**changes) -> DensityClock:
    return DensityClock(
        **{"progress": 0.2, "steps": 100, "taken": 1, "views": 5, "room": None, "seed": 1, **changes}
    )


@pytest.mark.parametrize("views", [1, 3, 30, 300, 3000, 15_000])
def test_every_number_of_views_gets_refinements(views):
    control = DensityControl(DensityConfig(refine_every=100))
    steps = range(1, 20 * max(views, 100) + 1)
    due = [s for s in steps if control.is_due(clock(steps=s, views=views))]
    assert len(due) >= 10
    assert all(b - a >= max(100, views) for a, b in pairwise(due))
    assert due[0] >= views


@pytest.mark.parametrize(("progress", "expected"), [(0.0, False), (0.1, True), (0.49, True), (0.5, False)])
def test_refinement_keeps_to_its_share_of_the_run(progress, expected):
    assert DensityControl(DensityConfig()).is_due(clock(progress=progress)) is expected


def test_a_block_grows_in_its_first_visit_unless_that_is_in_the_last_third():
    late = {"progress": 0.6, "refined": 0, "spent": 0.1}
    control = DensityControl(DensityConfig())
    assert control.is_due(clock(first=True, **late))
    assert not control.is_due(clock(first=True, **{**late, "progress": 0.71}))
    assert not control.is_due(clock(**late))
    assert not control.is_due(clock(first=True, **{**late, "spent": 0.6}))
    never = DensityControl(DensityConfig(refine_start=1.0, refine_stop=0.0))
    assert not never.is_due(clock(first=True, **late))


@pytest.mark.parametrize("steps", [17, 32, 39, 64, 250])
def test_a_first_visit_grows_though_its_views_are_drawn_about_once(steps):
    """It was refined in the warm-up, just now perhaps; later visits count from the one before."""
    control, batch = DensityControl(DensityConfig()), 4

    def due(first: bool) -> list[int]:
        drawn = batch * steps
        options = {"refined": 1000, "taken": batch, "views": drawn, "visit": drawn}
        each = (
            clock(steps=1000 + batch * k, spent=k / steps, first=first, **options)
            for k in range(1, steps + 1)
        )
        return [k for k, at in enumerate(each, start=1) if control.is_due(at)]

    assert due(first=True)
    assert not due(first=False)


@pytest.mark.parametrize(
    ("run", "views", "every"),
    [(1200, 26, 30), (1200, 68, 68), (3600, 26, 60), (3600, 255, 255), (30_000, 26, 100), (30_000, 255, 255)],
)
def test_a_warm_up_is_refined_by_its_share_of_a_short_run_but_by_all_views(run, views, every):
    """And as one block is in a long one."""
    control, refined, due = DensityControl(DensityConfig()), 0, []
    for steps in range(1, int(0.35 * run) + 1):
        at = clock(steps=steps, progress=steps / run, views=views, refined=refined, warm_up=True)
        if control.is_due(at):
            due.append(steps)
            refined = steps
    assert {b - a for a, b in pairwise(due)} == {every}
    assert due[0] == max(every, math.ceil(run / 60))


def test_a_warm_up_whose_run_has_no_end_is_refined_as_one_block_is():
    control = DensityControl(DensityConfig(refine_start=0.0))
    assert control.is_due(clock(steps=100, progress=0.0, refined=0, warm_up=True))
    assert not control.is_due(clock(steps=99, progress=0.0, refined=0, warm_up=True))


def test_opacities_are_reset_only_where_there_is_time_to_make_it_good():
    control = DensityControl(DensityConfig(reset_every=500))
    assert control.resets(clock(steps=500))
    assert control.resets(clock(steps=500, spent=0.4))
    assert not control.resets(clock(steps=500, spent=0.6))
    assert not control.resets(clock(steps=500, progress=0.6))
    assert not control.resets(clock(steps=500, refined=0))  # in a visit among others
    assert control.resets(clock(steps=500, refined=470, warm_up=True))


def test_a_block_among_others_refines_early_in_its_visits_and_makes_up_for_what_it_missed():
    control = DensityControl(DensityConfig(refine_every=30))
    late = {"views": 20, "taken": 4, "refined": 100, "spent": 0.6}
    assert not control.is_due(clock(steps=128, **{**late, "spent": 0.1}))
    assert control.is_due(clock(steps=132, **{**late, "spent": 0.1}))
    assert not control.is_due(clock(steps=132, **late))
    assert control.is_due(clock(steps=190, **{**late, "spent": 0.0}))  # overdue: no multiple of 30 is here
    assert not control.is_due(clock(steps=19, **{**late, "refined": 0, "spent": 0.0, "views": 40}))
