"""The warm-up: bounded, lossless, resumable."""

import math
from dataclasses import replace

import pytest
import torch

from abcd_ns.engine.events import VisitBegan, VisitEnded
from abcd_ns.engine.gaussians.initialize import split_off
from abcd_ns.engine.space.partition import build_kd
from abcd_ns.engine.store.scaffold import BEGINS, REVEALED_OPACITY, blocks_at_rest
from abcd_ns.engine.store.special_blocks import RESERVE, in_order
from abcd_ns.engine.train.density.control import DensityConfig, DensityControl
from abcd_ns.engine.train.training_loop import train, train_step
from abcd_ns.engine.types import Gaussians
from tests.reference.scenes import listen, make_coordinator, whole_scene

STILL = DensityConfig(strategy="off")
GROWING = DensityConfig(refine_start=0.0, refine_every=5, split_pixels=0.0, price=0.0)
LONG = {"blocks": 4, "steps": 60, "warmup": 0.5}
"""Enough for growth."""


@pytest.fixture(autouse=True)
def warm_up_is_not_prolonged(monkeypatch):
    """Its share of the run is known beforehand then."""
    monkeypatch.setattr("abcd_ns.engine.train.schedule.LONGER", 1)


def rows(gaussians: Gaussians) -> set[tuple[float, ...]]:
    return {tuple(row) for row in gaussians.quats.tolist()}


def test_scaffold_and_reserve_are_all_there_is(start):
    scaffold, waiting = split_off(start, 30, seed=3)
    assert len(scaffold) == 30
    assert rows(scaffold) | rows(waiting) == rows(start)
    assert not rows(scaffold) & rows(waiting)
    originals = {tuple(q): s for q, s in zip(start.quats.tolist(), start.scales, strict=True)}
    for quat, scales in zip(scaffold.quats.tolist(), scaffold.scales, strict=True):
        assert bool((scales >= originals[tuple(quat)]).all())
    assert float(scaffold.scales.mean()) > float(start.scales.mean()) + 0.2


def test_without_a_scaffold_nothing_waits(start):
    tree = build_kd(start.means, 4)
    assert sorted(blocks_at_rest(tree, start)) == [0, 1, 2, 3]
    assert in_order(blocks_at_rest(tree, start, room=30)) == [0, 1, 2, 3, RESERVE]


def test_where_all_fit_all_are_the_scaffold_and_nobody_waits(tmp_path, views, photos, start):
    coordinator = make_coordinator(
        tmp_path, start, views, blocks=4, steps=40, scaffold=1000, warmup=0.25, density=STILL
    )
    train(coordinator, photos, steps=3)
    assert coordinator.state.active.is_whole
    assert len(coordinator.params["means"]) == len(start)
    train(coordinator, photos, steps=7)
    assert coordinator.state.active is None
    assert len(whole_scene(coordinator)) == coordinator.count() == len(start)
    assert [coordinator.scene.count(block) for block in range(4)] == pytest.approx([30] * 4, abs=2)
    train(coordinator, photos)
    assert coordinator.finished


def test_the_whole_scaffold_is_live_and_nothing_else_is_seen(tmp_path, views, photos, start):
    coordinator = make_coordinator(tmp_path, start, views, blocks=4, steps=40, scaffold=30)
    train(coordinator, photos, steps=3)
    assert coordinator.state.active.is_whole
    assert (
        len(coordinator.params["means"])
        == coordinator.count()
        == len(whole_scene(coordinator))
        == math.ceil(BEGINS * 30)
    )
    batch = coordinator.next_batch()
    assert [sample.crop for sample in batch.samples] == [views[0].full]
    assert all(sample.layers is None for sample in batch.samples)


def test_when_it_ends_everyone_is_in_their_block_once(tmp_path, views, photos, start):
    coordinator = make_coordinator(
        tmp_path, start, views, blocks=4, steps=40, scaffold=30, warmup=0.25, density=STILL
    )
    begun = listen(coordinator, VisitBegan)
    train(coordinator, photos, steps=10)
    assert coordinator.state.active is None
    scene = coordinator.scene
    assert scene.rows(RESERVE) == 0
    for block in range(4):
        state = scene.state(block)
        assert bool((scene.tree.assign(state.gaussians.means) == block).all())
        waits = state.waits
        trained = (state.exp_avg.opacities[:, 0] != 0) | (state.exp_avg_sq.means.sum(dim=1) != 0)
        assert bool(waits.any())
        assert not bool((waits & trained).any())
        assert state.clocks.adam_views == 10
        assert state.clocks.visits == 0
        assert state.clocks.steps == 10
    assert coordinator.count() == 120
    train(coordinator, photos)
    assert [event.block for event in begun][:2] != [None, None]
    assert begun[0].block is None
    assert {event.block for event in begun[1:]} == {0, 1, 2, 3}


def test_who_waits_is_seen_when_their_block_is_visited_and_not_before(tmp_path, views, photos, start):
    coordinator = make_coordinator(
        tmp_path, start, views, blocks=4, steps=40, scaffold=30, warmup=0.25, density=STILL, heal=False
    )
    scene, visited = coordinator.scene, set()
    train(coordinator, photos, steps=10)
    assert len(whole_scene(coordinator)) == math.ceil(BEGINS * 30)
    for name, value in whole_scene(coordinator).items():
        assert torch.equal(getattr(scene.everything("cpu"), name), value), name
    while len(visited) < 4:
        coordinator.next_batch()
        active = coordinator.state.active
        if active.done == 0:
            live, found = coordinator.params["opacities"].detach()[:, 0], scene.count(active.geometry.block)
            faint = torch.sigmoid(live).sub(REVEALED_OPACITY).abs() < 1e-6
            assert len(live) == found
            assert bool(faint.any())
            # What windows and views go by.
            assert len(scene.gaussians_at_rest(active.geometry.block)) == found
            visited.add(active.geometry.block)
        for block in set(range(4)) - visited:
            assert 0 < len(scene.gaussians(block)) < scene.count(block)
        train_step(coordinator, photos)
    assert len(whole_scene(coordinator)) == coordinator.count() == 120
    assert torch.equal(scene.everything("cpu").means, whole_scene(coordinator).means)


@pytest.mark.parametrize("stop", [4, 10, 13])
def test_a_run_that_stops_and_goes_on_is_the_run_that_did_not(tmp_path, views, photos, start, stop):
    """Bit for bit: within the warm-up, at its end, and after it (invariant 7)."""
    runs = {}
    for name in ("whole", "stopped"):
        (tmp_path / name).mkdir()
        runs[name] = make_coordinator(
            tmp_path / name, start, views, blocks=4, steps=24, scaffold=30, warmup=0.4
        )
    train(runs["whole"], photos)
    train(runs["stopped"], photos, steps=stop)
    runs["stopped"].save()
    runs["stopped"].scene.store.close()
    again = make_coordinator(tmp_path / "stopped", start, views, steps=24, warmup=0.4, resume=True)
    train(again, photos)
    found, expected = whole_scene(again), whole_scene(runs["whole"])
    assert all(torch.equal(value, getattr(found, name)) for name, value in expected.items())


def test_no_more_is_live_than_in_the_largest_block(tmp_path, views, photos, start):
    coordinator = make_coordinator(
        tmp_path, start, views, blocks=4, steps=40, scaffold=30, density=STILL, warmup=0.25
    )
    most = 0
    while not coordinator.finished:
        train_step(coordinator, photos)
        most = max(most, len(coordinator.params["means"]))
    assert most <= 32  # a migrant or two


def test_density_controls_clock_is_the_runs(tmp_path, views, photos, start, monkeypatch):
    """It does not start anew when the warm-up is over, which grows as well."""
    coordinator = make_coordinator(
        tmp_path, start, views, blocks=4, steps=40, scaffold=30, warmup=0.5, density=STILL
    )
    found = []

    def watch(_control, _params, _optimizers, growth, _infos, _judged, clock):
        found.append(clock.progress)
        return growth

    monkeypatch.setattr(DensityControl, "after_step", watch)
    train(coordinator, photos)
    assert found == pytest.approx([(step + 1) / 40 for step in range(40)])


@pytest.mark.parametrize("most", [0, 125, 400])
def test_the_scaffold_grows_while_there_is_room_for_it(tmp_path, views, photos, start, most):
    """As a scene of one block does; what it has grown by, and its clocks, are in the blocks."""
    options = {**LONG, "scaffold": len(start), "scaffold_gaussians": most, "density": GROWING}
    coordinator = make_coordinator(tmp_path, start, views, **options)
    train(coordinator, photos, steps=29)
    live = len(coordinator.params["means"])
    assert live == coordinator.count()
    assert live == most if most == 125 else live > 125 if most else live <= len(start)
    train(coordinator, photos, steps=1)
    assert coordinator.state.active is None
    assert coordinator.count() == live
    assert coordinator.scene.clocks(0).refined > 0


def test_a_limit_on_gaussians_counts_those_that_wait(tmp_path, views, photos, start):
    density = replace(GROWING, max_gaussians=len(start))
    options = {**LONG, "scaffold": 60, "scaffold_gaussians": 100, "density": density}
    coordinator = make_coordinator(tmp_path, start, views, **options)
    train(coordinator, photos, steps=29)
    assert len(coordinator.params["means"]) <= 60


@pytest.mark.parametrize(("passes", "expected"), [(1, 5), (2, 10), (24, 25)])
def test_the_warm_up_ends_when_each_view_was_used_often_enough(
    tmp_path, views, photos, start, monkeypatch, passes, expected
):
    """Where it has no room for all: then, and not only when its share of the run is over."""
    monkeypatch.setattr("abcd_ns.engine.train.schedule.SCAFFOLD_PASSES", passes)
    coordinator = make_coordinator(
        tmp_path,
        start,
        views,
        blocks=4,
        steps=10 * len(views),
        scaffold=30,
        warmup=0.5,
        density=STILL,
    )
    ended = listen(coordinator, VisitEnded)
    while not ended:
        train_step(coordinator, photos)
    assert coordinator.state.step == expected
    assert not coordinator.state.active


@pytest.mark.parametrize(("passes", "expected"), [(1, 10), (3, 15), (24, 20)])
def test_the_warm_up_goes_on_for_twice_its_share_until_each_view_was_used_often_enough(
    tmp_path, views, photos, start, monkeypatch, passes, expected
):
    """Where it has room for all, views are few in relation to the run, or the run is short."""
    monkeypatch.setattr("abcd_ns.engine.train.schedule.SCAFFOLD_PASSES", passes)
    monkeypatch.setattr("abcd_ns.engine.train.schedule.LONGER", 2)
    options = {"blocks": 4, "steps": 50, "scaffold": len(start), "warmup": 0.2, "density": STILL}
    coordinator = make_coordinator(tmp_path, start, views, **options)
    ended = listen(coordinator, VisitEnded)
    while not ended:
        train_step(coordinator, photos)
    assert coordinator.state.step == expected
