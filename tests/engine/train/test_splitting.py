"""Blocks that outgrow their limit are cut in two: nothing lost, bounded, resumable."""

import pytest
import torch

from abcd_ns.engine.events import BlockSplit, VisitBegan, VisitEnded
from abcd_ns.engine.gaussians.block_state import BlockState, Clocks
from abcd_ns.engine.space.partition import build_kd
from abcd_ns.engine.store.special_blocks import RESERVE
from abcd_ns.engine.train.density import control
from abcd_ns.engine.train.density.control import DensityConfig
from abcd_ns.engine.train.density.splitting import FULL, cut_at_rest, split_full
from abcd_ns.engine.train.health_record import BlockHealth, standing
from abcd_ns.engine.train.recipe import Limits
from abcd_ns.engine.train.run_state import RunState
from abcd_ns.engine.train.schedule import VisitPlan
from abcd_ns.engine.train.training_loop import train, train_step
from tests.reference.scenes import listen, make_coordinator, random_gaussians, whole_scene

GROWING = DensityConfig(refine_start=0.0, refine_every=5, split_pixels=0.0)


def rows(state: BlockState) -> set[tuple[float, ...]]:
    return set(map(tuple, state.gaussians.means.tolist()))


@pytest.mark.parametrize("limit", [20, 60, 500])
def test_parts_are_small_enough_and_hold_everything(limit):
    gaussians = random_gaussians(300)
    tree = build_kd(gaussians.means, 3)
    owner = tree.assign(gaussians.means)
    settled = {b: BlockState.fresh(gaussians[owner == b]) for b in range(3)}
    settled = {b: BlockState(s.gaussians, s.exp_avg, s.exp_avg_sq, {}, Clocks(b)) for b, s in settled.items()}
    cut, parts, parents = split_full(tree, settled, Limits(limit))
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


def test_the_reserve_is_no_block():
    gaussians = random_gaussians(50)
    tree = build_kd(gaussians.means, 1)
    waiting = BlockState.fresh(gaussians)
    assert split_full(tree, {RESERVE: waiting}, Limits(10)) == (tree, {RESERVE: waiting}, {})


def test_a_part_is_visited_next_to_the_block_it_came_from():
    state = RunState(queue=[VisitPlan(0, 5), VisitPlan(1, 7)], views={0: 3, 1: 4}, influence={0: {2: 0.5}})
    state.inherit(2, 0)
    state.inherit(3, 1)
    assert state.queue == [VisitPlan(0, 5), VisitPlan(2, 5), VisitPlan(1, 7), VisitPlan(3, 7)]
    assert (state.views[2], state.views[3]) == (3, 4)
    assert state.influence == {0: {2: 0.5}, 2: {2: 0.5}}
    state.influence[2][2] = 0.1
    assert state.influence[0][2] == 0.5


def test_a_part_has_had_the_visits_of_the_block_it_came_from():
    state = RunState(health={0: BlockHealth(visits=3, shed=7)})
    state.inherit(2, 0)
    state.inherit(3, 1)
    assert state.health.keys() == {0, 2}
    assert state.health[2] == BlockHealth(visits=3)  # what was shed is told once
    assert standing(2, state.health[2], {}) == "trained"


@pytest.mark.parametrize("blocks", [1, 2])
def test_a_run_never_has_a_larger_block_than_it_may(tmp_path, views, photos, start, blocks, monkeypatch):
    monkeypatch.setattr(control, "MOST_NEW", 1.0)
    limit = 130
    coordinator = make_coordinator(
        tmp_path, start, views, blocks=blocks, steps=50, density=GROWING, block_limit=limit, warmup=0.0
    )
    seen = []
    coordinator.announce.subscribe(seen.append)
    largest = 0
    while not coordinator.finished:
        train_step(coordinator, photos)
        largest = max(largest, len(coordinator.params["means"]))
    cuts = [event for event in seen if isinstance(event, BlockSplit)]
    assert cuts
    assert largest <= limit
    tree = coordinator.scene.tree
    assert tree.num_blocks == blocks + len(cuts)
    assert {event.block for event in seen if isinstance(event, VisitBegan)} >= {cut.new for cut in cuts[:1]}
    assert coordinator.scene.store.header["tree"] == tree.to_json()
    for block in range(tree.num_blocks):
        means = coordinator.scene.gaussians_at_rest(block).means
        assert bool((tree.assign(means) == block).all())


def test_a_block_that_is_alone_may_be_larger_until_it_is_cut(tmp_path, views, photos, start):
    options = {"blocks": 1, "steps": 50, "density": GROWING, "block_limit": 90, "warmup": 0.0}
    coordinator = make_coordinator(tmp_path, start, views, **options, sole_limit=200)
    ended = listen(coordinator, VisitEnded)
    train(coordinator, photos)
    alone, *others = (visit.gaussians for visit in ended)
    assert 0.75 * 200 < alone <= 200
    assert 0 < max(others) <= 90
    shares = coordinator.state.influence  # known, so that each part is trained on the views that show it
    assert {view for shown in shares.values() for view in shown} == {view.index for view in views}
    assert len(shares) > 1


def test_a_block_that_has_room_is_not_cut(tmp_path, views, photos, start):
    options = {"blocks": 1, "steps": 30, "density": GROWING, "block_limit": 20, "warmup": 0.0}
    coordinator = make_coordinator(tmp_path, start, views, **options, sole_limit=10**6)
    train(coordinator, photos)
    assert coordinator.scene.tree.num_blocks == 1


def test_a_run_that_was_cut_resumes_bit_for_bit(tmp_path, views, photos, start):
    options = {"blocks": 2, "steps": 50, "density": GROWING, "block_limit": 75, "warmup": 0.0}
    whole, halves = tmp_path / "whole", tmp_path / "halves"
    whole.mkdir()
    halves.mkdir()
    expected = make_coordinator(whole, start, views, **options)
    train(expected, photos)
    first = make_coordinator(halves, start, views, **options)
    while first.scene.tree.num_blocks == 2 or first.state.active is None:
        assert not first.finished
        train_step(first, photos)
    train(first, photos, 3)
    first.save()
    first.scene.store.close()
    second = make_coordinator(halves, start, views, resume=True, **options)
    assert second.scene.tree.num_blocks > 2
    train(second, photos)
    assert expected.scene.tree == second.scene.tree
    for (_, a), (_, b) in zip(whole_scene(expected).items(), whole_scene(second).items(), strict=True):
        assert torch.equal(a, b)


def test_what_need_not_be_cut_is_not_written_again(tmp_path, views, start):
    coordinator = make_coordinator(tmp_path, start, views, blocks=1)
    scene, store = coordinator.scene, coordinator.scene.store
    generation = store.generation
    cut_at_rest(scene, RunState(), Limits(20, sole_limit=10**6))
    assert (store.generation, scene.tree.num_blocks) == (generation, 1)
    cut_at_rest(scene, RunState(), Limits(20))
    assert scene.tree.num_blocks > 1


def test_a_block_that_was_the_whole_scene_is_cut_though_its_visit_was_under_way(
    tmp_path, views, photos, start
):
    options = {"blocks": 1, "steps": 30, "density": DensityConfig(strategy="off"), "warmup": 0.0}
    first = make_coordinator(tmp_path, start, views, **options)
    train(first, photos, 4)
    first.save()
    scene, store = first.scene, first.scene.store
    state = RunState.from_json(store.state)
    assert state.active.saved
    scene.clear_live()
    cut_at_rest(scene, state, Limits(40, sole_limit=50))
    assert scene.tree.num_blocks > 2
    assert sum(map(scene.count, range(scene.tree.num_blocks))) == len(start)
    store.close()
    again = make_coordinator(tmp_path, start, views, resume=True, block_limit=40, sole_limit=50, **options)
    assert again.state.step == 4
    largest = 0
    while not again.finished:
        train_step(again, photos)
        largest = max(largest, len(again.params["means"]))
    assert largest <= 40
    assert len(whole_scene(again)) == len(start)


def test_of_several_blocks_all_are_cut_but_the_one_whose_visit_was_under_way(tmp_path, views, photos, start):
    options = {"blocks": 2, "steps": 30, "density": DensityConfig(strategy="off"), "warmup": 0.0}
    first = make_coordinator(tmp_path, start, views, **options)
    train(first, photos, 4)
    first.save()
    scene, store, state = first.scene, first.scene.store, RunState.from_json(first.scene.store.state)
    block, step = state.active.geometry.block, state.step
    scene.clear_live()
    before = scene.rows(block)
    cut_at_rest(scene, state, Limits(40))
    assert state.active is not None
    assert scene.rows(block) == before
    assert scene.rows(1 - block) <= FULL * 40
    store.close()
    again = make_coordinator(tmp_path, start, views, resume=True, block_limit=40, **options)
    assert again.state.step == step
    train(again, photos)
    assert len(whole_scene(again)) == len(start)
    assert max(map(again.scene.rows, range(again.scene.tree.num_blocks))) <= FULL * 40


def test_a_run_goes_on_with_a_smaller_limit(tmp_path, views, photos, start):
    options = {"blocks": 2, "steps": 30, "density": DensityConfig(strategy="off"), "warmup": 0.0}
    first = make_coordinator(tmp_path, start, views, **options)
    while first.state.visit == 0 or first.state.active is not None:
        train_step(first, photos)
    before = rows(BlockState.fresh(whole_scene(first)))
    scene, store = first.scene, first.scene.store
    cut_at_rest(scene, RunState.from_json(store.state), Limits(40))
    assert scene.tree.num_blocks > 2
    assert max(map(scene.count, range(scene.tree.num_blocks))) <= FULL * 40
    assert rows(BlockState.fresh(whole_scene(first))) == before
    generation = store.generation
    cut_at_rest(scene, RunState.from_json(store.state), Limits(40))
    assert store.generation == generation
    store.close()
    again = make_coordinator(tmp_path, start, views, resume=True, block_limit=40, **options)
    begun = listen(again, VisitBegan)
    train(again, photos)
    assert max(event.block for event in begun) >= 2
