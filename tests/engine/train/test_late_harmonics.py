"""Where memory cuts a scene, harmonics come once growth is over, as far as there is room."""

import pytest

from abcd_ns.engine.gaussians.param_swap import active_gaussians
from abcd_ns.engine.gaussians.spherical_harmonics import degrees_in_use
from abcd_ns.engine.train.memory import limits_at
from abcd_ns.engine.train.training_loop import train, train_step
from tests.reference.scenes import STILL, assert_resumes, steps_of, whole_scene

LATE = {"blocks": 4, "steps": 96, "density": STILL, "late_harmonics": 2}
ROOMY, TIGHT = 1000, 34
"""Gaussians that a block may have while it grows; there are 30."""


@pytest.fixture
def start(start):
    return start.of_degree(0).of_degree(start.sh_degree)


def highest_of(coordinator) -> int:
    return int(degrees_in_use([whole_scene(coordinator).features_rest]).max())


def test_what_is_active_has_no_more_harmonics_than_are_in_use(make, photos, start):
    coordinator, found = make(block_limit=ROOMY, **LATE), set()
    for _ in steps_of(coordinator, photos):
        if coordinator.state.active is not None:
            found.add((coordinator.run.share < 0.5, active_gaussians(coordinator.params).sh_degree))
    assert {degree for is_early, degree in found if is_early} == {0}
    assert (False, start.sh_degree) in found
    assert highest_of(coordinator) == start.sh_degree


def test_blocks_that_have_no_room_for_them_are_cut_in_two_as_a_visit_begins_after_growth(make, photos, start):
    coordinator, blocks, begun = make(block_limit=TIGHT, **LATE), set(), {}
    while not coordinator.finished:
        is_early = coordinator.run.share < 0.5
        train_step(coordinator, photos)
        blocks.add((coordinator.run.share < 0.5, coordinator.scene.tree.num_blocks))
        if (active := coordinator.state.active) is not None:
            begun.setdefault(active.number, (is_early, active.sh_degree))
    assert {count for is_early, count in blocks if is_early} == {4}
    assert {degree for is_early, degree in begun.values() if not is_early} == {start.sh_degree}
    assert highest_of(coordinator) == start.sh_degree
    room = limits_at(coordinator.config, start.sh_degree)
    counts = map(coordinator.scene.count, range(coordinator.scene.tree.num_blocks))
    assert not any(room.is_full(count, 8) for count in counts)


def test_a_single_block_without_room_goes_on_without_them(make, photos):
    coordinator = make(block_limit=4 * TIGHT, **{**LATE, "blocks": 1})
    train(coordinator, photos)
    assert coordinator.scene.tree.num_blocks == 1
    assert highest_of(coordinator) == 0


@pytest.mark.parametrize(("blocks", "stop", "limit"), [(1, 47, ROOMY), (4, 60, ROOMY), (4, 60, TIGHT)])
def test_such_a_run_resumes_as_if_it_had_not_stopped(make, photos, blocks, stop, limit):
    """Just before they come, while they are there, and while blocks are cut for them."""
    assert_resumes(make, photos, stop, **{**LATE, "blocks": blocks}, block_limit=limit)


def test_while_the_degree_rises_others_see_all_harmonics(make, photos, start):
    """As a viewer does, which draws with the highest degree at any time."""
    coordinator = make(blocks=1, steps=40, density=STILL)
    train(coordinator, photos, steps=1)
    assert active_gaussians(coordinator.params).sh_degree < start.sh_degree
    assert coordinator.scene.gaussians(0).sh_degree == start.sh_degree
    assert coordinator.scene.everything("cpu").sh_degree == start.sh_degree


def test_a_degree_that_rises_within_a_step_waits_for_the_next(make, monkeypatch):
    """As where a run's budget is time."""
    coordinator = make(blocks=1, steps=40, density=STILL)
    batch = coordinator.next_batch()
    monkeypatch.setattr(type(coordinator.run), "sh_degree", 1)
    coordinator.render(batch)
    assert active_gaussians(coordinator.params).sh_degree == 0
    coordinator.next_batch()
    assert active_gaussians(coordinator.params).sh_degree == 1
