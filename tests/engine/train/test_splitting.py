"""Blocks that outgrow their limit are cut in two: nothing lost, bounded, resumable."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from abcd_ns.engine.events import BlockSplit, CutAnew, VisitBegan, VisitEnded
from abcd_ns.engine.gaussians.block_state import BlockState, Clocks
from abcd_ns.engine.space.partition import build_kd
from abcd_ns.engine.store.commit import with_pending
from abcd_ns.engine.store.special_blocks import DEFERRED, PENDING, WHOLE
from abcd_ns.engine.train.density import control
from abcd_ns.engine.train.density.splitting import cut_anew, end_joint, split_full
from abcd_ns.engine.train.planner import REFILLED
from abcd_ns.engine.train.recipe import FULL, Limits
from abcd_ns.engine.train.run_state import BlockHealth, RunState, standing
from abcd_ns.engine.train.schedule import VisitPlan
from abcd_ns.engine.train.training_loop import train, train_step
from tests.reference.scenes import (
    GROWING,
    STILL,
    assert_resumes,
    listen,
    random_gaussians,
    steps_of,
    whole_scene,
)


def rows(state: BlockState) -> set[tuple[float, ...]]:
    return set(map(tuple, state.gaussians.means.tolist()))


@pytest.mark.parametrize("limit", [20, 60, 500])
def test_parts_are_small_enough_and_hold_everything(limit):
    gaussians = random_gaussians(300)
    tree = build_kd(gaussians.means, 3)
    owner = tree.assign(gaussians.means)
    updates = {b: replace(BlockState.fresh(gaussians[owner == b]), clocks=Clocks(b)) for b in range(3)}
    cut, parts, parents = split_full(tree, updates, Limits(limit))
    assert all(len(state) <= FULL * limit for state in parts.values())
    assert set().union(*map(rows, parts.values())) == rows(BlockState.fresh(gaussians))
    assert cut.num_blocks == len(parts) == 3 + len(parents)
    for block, state in parts.items():
        assert bool((cut.assign(state.gaussians.means) == block).all())
        origin = block
        while origin in parents:
            origin = parents[origin]
        assert state.clocks.steps == origin
    assert (limit < 100 / FULL) == bool(parents)


def test_what_cannot_be_parted_is_left_as_it_is():
    gaussians = random_gaussians(50)
    gaussians.means[:] = 0.5
    tree = build_kd(gaussians.means, 1)
    cut, parts, parents = split_full(tree, {0: BlockState.fresh(gaussians)}, Limits(10))
    assert (cut, list(parts), parents) == (tree, [0], {})
    deferred = {DEFERRED: BlockState.fresh(random_gaussians(50))}
    assert split_full(tree, deferred, Limits(10)) == (tree, deferred, {})  # it is no block


def test_a_part_is_visited_next_to_the_block_it_came_from_and_has_had_its_visits():
    state = RunState(queue=[VisitPlan(0, 5), VisitPlan(1, 7)], views={0: 3, 1: 4}, influence={0: {2: 0.5}})
    state.health[0] = BlockHealth(visits=3, pruned=7)
    state.active = SimpleNamespace(visible={4: (0, 1), 5: (1,)})
    state.inherit(2, 0)
    state.inherit(3, 1)
    assert state.queue == [VisitPlan(0, 5), VisitPlan(2, 5), VisitPlan(1, 7), VisitPlan(3, 7)]
    assert (state.views[2], state.views[3]) == (3, 4)
    assert state.influence == {0: {2: 0.5}, 2: {2: 0.5}}
    assert state.active.visible == {4: (0, 1, 2, 3), 5: (1, 3)}
    state.influence[2][2] = 0.1
    assert state.influence[0][2] == 0.5
    assert state.health.keys() == {0, 2}
    assert state.health[2] == BlockHealth(visits=3)  # what was pruned is told once
    assert standing(2, state.health[2], {}) == "trained"


def test_a_run_never_has_a_larger_block_than_it_may(make, photos, monkeypatch):
    monkeypatch.setattr(control, "MOST_NEW", 1.0)
    limit, blocks = 130, 2
    coordinator = make(blocks=blocks, steps=50, density=GROWING, block_limit=limit, warmup=0.0)
    cuts, begun = listen(coordinator, BlockSplit), listen(coordinator, VisitBegan, lambda event: event.block)
    run = coordinator.run
    sizes = [(len(run.params["means"]), run.blocks) for _ in steps_of(coordinator, photos)]
    assert max(gaussians for gaussians, _ in sizes) <= limit
    assert max(count for _, count in sizes) == blocks + len(cuts) > blocks
    assert cuts[0].new in begun
    tree = coordinator.scene.tree
    assert coordinator.scene.store.header["tree"] == tree.to_json()
    for block in range(tree.num_blocks):
        means = coordinator.scene.stored_with_pending(block).means
        assert bool((tree.assign(means) == block).all())


def test_a_block_that_is_alone_may_be_larger_until_it_is_cut(make, views, photos):
    options = {"blocks": 1, "steps": 50, "density": GROWING, "block_limit": 90, "warmup": 0.0}
    coordinator = make(**options, sole_limit=170)
    ended = listen(coordinator, VisitEnded)
    train(coordinator, photos)
    alone, *others = (visit.gaussians for visit in ended)
    assert FULL * 170 < alone <= 170
    assert 0 < max(others) <= 90
    shares = coordinator.state.influence  # known, so that each part is trained on the views that show it
    assert {view for shown in shares.values() for view in shown} == {view.index for view in views}
    assert len(shares) > 1


def test_a_run_that_was_cut_resumes_bit_for_bit(make, photos):
    options = {"blocks": 2, "steps": 50, "density": GROWING, "block_limit": 75, "warmup": 0.0}
    first = make("first", **options)
    while first.scene.tree.num_blocks == 2 or first.state.active is None:
        train_step(first, photos)
    whole, resumed = assert_resumes(make, photos, first.state.step + 3, **options)
    assert whole.scene.tree == resumed.scene.tree


CUT_ANEW = {"blocks": 6, "steps": 60, "density": STILL, "block_limit": 30, "warmup": 0.0}


def test_once_growth_is_over_blocks_that_are_not_full_become_fewer(make, photos, start):
    coordinator, blocks = make(**CUT_ANEW), math.ceil(len(start) / (REFILLED * CUT_ANEW["block_limit"]))
    cuts, begun = listen(coordinator, CutAnew), listen(coordinator, VisitBegan)
    counts = {(coordinator.run.share < 0.5, coordinator.run.blocks) for _ in steps_of(coordinator, photos)}
    assert cuts == [CutAnew(blocks)]
    assert counts >= {(True, 6), (False, blocks)}
    assert (True, blocks) not in counts
    assert {event.block for event in begun[-blocks:]} == set(range(blocks))
    assert max(event.gaussians for event in begun[-blocks:]) <= FULL * CUT_ANEW["block_limit"]
    assert len(whole_scene(coordinator)) == len(start)
    assert sum(map(coordinator.scene.store.counts, range(6))) <= len(start)  # none is stored twice


def test_a_scene_that_is_cut_anew_keeps_moments_and_pending_migrants(make, photos):
    coordinator = make(blocks=4, steps=40, density=STILL, warmup=0.0)
    train(coordinator, photos)
    scene, first = coordinator.scene, coordinator.scene.state(0)
    migrants = {0: first[3:], PENDING: replace(first[:3], clocks=Clocks())}
    scene.persist(scene.tree, migrants, coordinator.state.to_json())
    all_rows = [with_pending(scene, block) for block in range(4)]
    tree, updates = cut_anew(scene, 2)
    assert tree.num_blocks == 2
    assert updates.keys() == {0, 1, 2, 3, PENDING}
    assert [len(updates[name]) for name in (2, 3, PENDING)] == [0, 0, 0]
    for parts in (lambda state: state.gaussians, lambda state: state.exp_avg):
        before, after = (
            torch.cat([parts(state).means for state in states]) for states in (all_rows, updates.values())
        )
        assert sorted(map(tuple, before.tolist())) == sorted(map(tuple, after.tolist()))
    for block in (0, 1):
        assert bool((tree.assign(updates[block].gaussians.means) == block).all())
        assert updates[block].clocks in [state.clocks for state in all_rows]


def test_what_was_repaired_in_blocks_that_are_no_more_is_still_told():
    state = RunState(views={0: 3, 1: 4, 2: 1}, epoch=4)
    state.health = {
        WHOLE: BlockHealth(pruned=1),
        0: BlockHealth(visits=3, pruned=7),
        2: BlockHealth(visits=2),
    }
    state.renumber(2, {0: {5: 0.5}})
    assert state.health[WHOLE].pruned == 8
    assert state.health[1] == BlockHealth(visits=2)
    assert (state.epoch, state.views, state.influence) == (5, {}, {0: {5: 0.5}})
    assert state.health.keys() == {WHOLE, 0, 1}


def test_a_run_that_was_cut_anew_resumes_bit_for_bit(make, photos):
    first = make("first", **CUT_ANEW)
    while first.scene.tree.num_blocks == 6 or first.state.active is None:
        train_step(first, photos)
    whole, resumed = assert_resumes(make, photos, first.state.step + 3, **CUT_ANEW)
    assert whole.scene.tree == resumed.scene.tree


@pytest.mark.parametrize(("blocks", "sole_limit"), [(1, 50), (2, 0)])
def test_a_run_with_a_smaller_limit_goes_on_within_the_visit_that_was_under_way(
    make, photos, start, blocks, sole_limit
):
    """A block is not cut whose visit was under way, unless it was the whole scene."""
    options = {"blocks": blocks, "steps": 30, "density": STILL, "warmup": 0.0}
    first = make(**options)
    train(first, photos, 4)
    first.save()
    scene, state = first.scene, RunState.from_json(first.scene.store.state)
    assert state.active.saved
    scene.clear_active()
    end_joint(scene, state, Limits(40, sole_limit=sole_limit))
    assert sum(map(scene.count, range(scene.tree.num_blocks))) == len(start)
    assert (state.active is None) == (blocks == 1)
    first.close()
    again = make(resume=True, block_limit=40, sole_limit=sole_limit, **options)
    assert again.state.step == 4
    begun = listen(again, VisitBegan)
    train(again, photos)
    assert max(event.gaussians for event in begun) <= 40
    assert max(event.block for event in begun) >= 2
    assert max(map(again.scene.rows, range(again.scene.tree.num_blocks))) <= FULL * 40
    assert len(whole_scene(again)) == len(start)
