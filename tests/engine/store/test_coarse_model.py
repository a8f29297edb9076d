"""The warm-up: bounded, lossless, resumable."""

from dataclasses import replace

import pytest
import torch

from abcd_ns.engine.events import VisitBegan, VisitEnded
from abcd_ns.engine.gaussians.block_state import BlockState
from abcd_ns.engine.gaussians.initialize import cloud_from_points, random_points, split_off
from abcd_ns.engine.space.partition import build_kd
from abcd_ns.engine.store.coarse_model import REVEALED_OPACITY, stored_blocks
from abcd_ns.engine.store.special_blocks import DEFERRED
from abcd_ns.engine.train.training_loop import train, train_step
from tests.reference.scenes import STILL, UNPRUNED, equal, listen, steps_of, whole_scene

LONG = {"blocks": 4, "steps": 60, "warmup": 0.5}
"""Enough for growth."""


@pytest.fixture(autouse=True)
def warm_up_is_not_prolonged(monkeypatch):
    """Its share of the run is known beforehand then."""
    monkeypatch.setattr("abcd_ns.engine.train.schedule.LONGER", 1)


def test_a_store_begins_with_each_point_in_its_block_or_deferred():
    cloud = cloud_from_points(*random_points(90, 2.0), sh_degree=1)
    tree = build_kd(cloud.means, 4)
    coarse, others = split_off(cloud, 40, seed=3)
    content = dict(stored_blocks(tree, cloud, room=40, seed=3))
    deferred = content.pop(DEFERRED)
    assert all(torch.equal(deferred.tensors[name], value) for name, value in others.tensors.items())
    owner, whole = tree.assign(coarse.means), coarse.gaussians()
    for block, packed in content.items():
        state = BlockState.unpacked(packed)
        assert equal(state.gaussians, whole[owner == block])
        assert not bool(state.deferred.any() | state.exp_avg.means.any() | state.exp_avg_sq.quats.any())
    assert list(content) == [0, 1, 2, 3]


def test_the_whole_coarse_model_is_active_and_nothing_else_is_seen(make, views, photos):
    coordinator = make(blocks=4, steps=40, coarse_model=30)
    train(coordinator, photos, steps=3)
    assert coordinator.state.active.is_whole
    assert len(coordinator.params["means"]) == coordinator.count() == len(whole_scene(coordinator)) == 30
    batch = coordinator.next_batch()
    assert [sample.crop for sample in batch.samples] == [views[0].full]
    assert all(sample.layers is None for sample in batch.samples)


def test_when_it_ends_everyone_is_in_their_block_once(make, photos):
    coordinator = make(blocks=4, steps=40, coarse_model=30, warmup=0.25, density=STILL)
    begun = listen(coordinator, VisitBegan)
    train(coordinator, photos, steps=10)
    assert coordinator.state.active is None
    scene = coordinator.scene
    assert scene.rows(DEFERRED) == 0
    for block in range(4):
        state = scene.state(block)
        assert bool((scene.tree.assign(state.gaussians.means) == block).all())
        trained = (state.exp_avg.opacities[:, 0] != 0) | (state.exp_avg_sq.means.sum(dim=1) != 0)
        assert bool(state.deferred.any())
        assert not bool((state.deferred & trained).any())
        assert (state.clocks.steps, state.clocks.adam_views, state.clocks.visits) == (10, 10, 0)
    assert coordinator.count() == 120
    for _ in steps_of(coordinator, photos):
        assert len(coordinator.params["means"]) <= 32  # a block, and a migrant or two
    assert begun[0].block is None
    assert {event.block for event in begun[1:]} == {0, 1, 2, 3}


def test_who_waits_is_seen_when_their_block_is_visited_and_not_before(make, photos):
    coordinator = make(blocks=4, steps=40, coarse_model=30, warmup=0.25, density=STILL, limit_scales=False)
    scene, visited = coordinator.scene, set()
    train(coordinator, photos, steps=10)
    assert len(whole_scene(coordinator)) == 30
    assert equal(whole_scene(coordinator), scene.everything("cpu"))
    while len(visited) < 4:
        coordinator.next_batch()
        active = coordinator.state.active
        if active.done == 0:
            block = active.geometry.block
            opacities = torch.sigmoid(coordinator.params["opacities"].detach())
            assert bool(((opacities - REVEALED_OPACITY).abs() < 1e-6).any())
            # What windows and views go by.
            assert len(opacities) == scene.count(block) == len(scene.stored_with_pending(block))
            visited.add(block)
        for block in set(range(4)) - visited:
            assert 0 < len(scene.gaussians(block)) < scene.count(block)
        train_step(coordinator, photos)
    assert len(whole_scene(coordinator)) == coordinator.count() == 120
    assert torch.equal(scene.everything("cpu").means, whole_scene(coordinator).means)


@pytest.mark.parametrize("most", [0, 125, 400])
def test_the_coarse_model_grows_while_there_is_room_for_it(make, photos, start, most):
    """As a scene of one block does; what it has grown by, and its clocks, are in the blocks."""
    coordinator = make(**LONG, coarse_model=len(start), coarse_gaussians=most, density=UNPRUNED)
    train(coordinator, photos, steps=29)
    active = len(coordinator.params["means"])
    assert active == coordinator.count()
    assert active == most if most == 125 else active > 125 if most else active <= len(start)
    train(coordinator, photos, steps=1)
    assert coordinator.state.active is None
    assert coordinator.count() == active
    assert coordinator.scene.clocks(0).refined > 0


def test_a_limit_on_gaussians_counts_those_that_wait(make, photos, start):
    density = replace(UNPRUNED, max_gaussians=len(start))
    coordinator = make(**LONG, coarse_model=60, coarse_gaussians=100, density=density)
    train(coordinator, photos, steps=29)
    assert len(coordinator.params["means"]) <= 60


@pytest.mark.parametrize(
    ("coarse_model", "warmup", "longer", "passes", "expected"),
    [(30, 0.5, 1, 2, 10), (120, 0.2, 2, 3, 15), (120, 0.2, 2, 24, 20)],
)
def test_the_warm_up_ends_when_each_view_was_used_often_enough(
    make, photos, monkeypatch, coarse_model, warmup, longer, passes, expected
):
    """Where it has no room for all: then, and not only when its share of the run is over. Where it has, after
    twice its share at most, and not before its share is over."""
    monkeypatch.setattr("abcd_ns.engine.train.schedule.COARSE_MODEL_PASSES", passes)
    monkeypatch.setattr("abcd_ns.engine.train.schedule.WARM_UP_PASSES", passes)
    monkeypatch.setattr("abcd_ns.engine.train.schedule.LONGER", longer)
    coordinator = make(blocks=4, steps=50, coarse_model=coarse_model, warmup=warmup, density=STILL)
    ended = listen(coordinator, VisitEnded)
    while not ended:
        train_step(coordinator, photos)
    assert coordinator.state.step == expected
    assert not coordinator.state.active


def test_a_visit_in_which_deferred_points_join_prunes_none(make, photos):
    density = replace(UNPRUNED, min_contribution=1e9, refine_stop=0.0)
    coordinator = make(blocks=2, steps=400, coarse_model=30, warmup=0.1, density=density)
    counts = listen(coordinator, VisitEnded, lambda _: coordinator.count())
    while len(counts) < 4:
        train_step(coordinator, photos)
    assert counts[:3] == [90] * 3  # the coarse model goes; each block's first visit
    assert counts[3] < 90
