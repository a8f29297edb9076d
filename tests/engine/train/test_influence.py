"""A block is trained on the views that it has influence on."""

from dataclasses import replace

import pytest
import torch

from abcd_ns.engine.events import VisitBegan, VisitEnded
from abcd_ns.engine.gaussians.block_state import MOMENTS
from abcd_ns.engine.gaussians.initialize import cloud_from_points
from abcd_ns.engine.render import Shot
from abcd_ns.engine.space.influence import influence, weights
from abcd_ns.engine.train.density.control import DensityConfig
from abcd_ns.engine.train.step.layer_source import influence_by_layers
from abcd_ns.engine.train.training_loop import train
from abcd_ns.engine.types import Gaussians
from abcd_ns.lab.world.world import camera
from tests.engine.train.test_coordinator import off_from_merged
from tests.reference.scenes import (
    STILL,
    listen,
    make_coordinator,
    random_gaussians,
    ring_of_views,
    whole_scene,
)

PRICED = DensityConfig(min_contribution=1.0, refine_every=1000)


@pytest.fixture
def begin(make):
    """Makes runs with a warm-up of 12 steps."""

    given = {"blocks": 4, "steps": 60, "warmup": 0.2, "density": STILL, "coarse_model": 40}
    return lambda **options: make(**{**given, **options})


@pytest.fixture
def grown(begin, photos):
    def made(**options):
        coordinator = begin(**options)
        train(coordinator, photos, steps=12)
        return coordinator

    return made


def blindfold(coordinator, monkeypatch, blind: tuple[int, ...]) -> None:
    """From now on these views see no block."""
    extents = coordinator.run.rasterizer.extents
    nowhere = torch.tensor([torch.inf, torch.inf, -torch.inf, -torch.inf])

    def watched(gaussians, views):
        found = zip(views, extents(gaussians, views), strict=True)
        return torch.stack([nowhere if view.index in blind else row for view, row in found])

    monkeypatch.setattr(coordinator.run.rasterizer, "extents", watched)


def visits_of(coordinator) -> list[tuple[int, tuple[int, ...], tuple[int, ...]]]:
    """(block, views, those that are looked at because they are doubtful), which grows as visits begin."""

    def note(event):
        return event.block, coordinator.state.active.views, coordinator.state.active.looked_at

    return listen(coordinator, VisitBegan, note)


def test_views_that_hardly_show_a_block_are_left_out_but_looked_at_in_turn(grown, photos):
    coordinator = grown(influence_share=0.6)
    seen, known = visits_of(coordinator), coordinator.state.influence
    assert sorted(known) == [0, 1, 2, 3]
    assert all(0 < sum(row[view] for row in known.values()) <= 1 + 1e-5 for view in range(5))
    train(coordinator, photos)
    assert any(len(used) < 5 for _, used, _ in seen)
    assert all(len(looked_at) <= 1 and set(looked_at) <= set(used) for _, used, looked_at in seen)
    assert {block for block, _, looked_at in seen if looked_at} == {0, 1, 2, 3}


def assert_known_is_what_shows(coordinator, views, rel: float) -> None:
    """Each view's influence, of all blocks together."""
    whole, known = whole_scene(coordinator), coordinator.state.influence.values()
    for view in views:
        seen = float(weights(whole, coordinator.run.rasterizer, [Shot(view, view.full)]).sum())
        told = sum(row.get(view.index, 0.0) for row in known)
        assert told == pytest.approx(seen / view.full.pixels, rel=rel)


def test_the_warm_up_draws_no_view_again_that_it_has_used(begin, views, photos, start, monkeypatch):
    drawn = []

    def watched(gaussians, owner, others, *rest, **options):
        drawn.extend(others)
        return influence(gaussians, owner, others, *rest, **options)

    monkeypatch.setattr("abcd_ns.engine.train.coordinator.influence", watched)
    coordinator = begin(density=PRICED, coarse_model=len(start))
    train(coordinator, photos, steps=4)
    coordinator.save()
    coordinator.restore()
    assert len(coordinator.visit.influence.found()[1]) == 1
    while coordinator.state.visit == 1:
        train(coordinator, photos, steps=1)
    assert not drawn
    assert_known_is_what_shows(coordinator, views, rel=0.1)


def test_what_is_drawn_in_part_is_drawn_again_to_know_its_influence(begin, views, photos):
    coordinator = begin(density=PRICED, crop_pixels=views[0].full.pixels // 4)
    while coordinator.state.visit < 2:
        train(coordinator, photos, steps=1)
    assert_known_is_what_shows(coordinator, views, rel=0.15)


def test_a_block_that_no_view_is_known_to_show_is_trained_on_all_that_see_it(grown, photos):
    coordinator = grown()
    coordinator.state.influence = {0: {}, 1: {99: 0.5}}
    seen = visits_of(coordinator)
    train(coordinator, photos)
    first = {block: sorted(views) for block, views, _ in reversed(seen)}
    assert first == {block: [0, 1, 2, 3, 4] for block in range(4)}


def test_when_the_warm_up_is_over_nothing_of_it_stays_active(begin, photos):
    coordinator = begin()

    def rows(_) -> set[int]:
        moments = (coordinator.optimizers[name].state[p] for name, p in coordinator.params.items())
        held = [*coordinator.params.values(), *(each[name] for each in moments for name in MOMENTS)]
        return {len(tensor) for tensor in held}

    ended = listen(coordinator, VisitEnded, rows)
    train(coordinator, photos, steps=12)
    assert ended == [{0}]


def test_views_that_show_a_block_no_more_are_found_out(grown, monkeypatch):
    coordinator, blind = grown(visit_views=2), (0, 1, 2)
    blindfold(coordinator, monkeypatch, blind)
    coordinator.state.influence = {block: dict.fromkeys(blind, 0.1) for block in range(4)}
    for _ in range(4):
        active = coordinator.visits.begin()
        assert active.trained_on == (3, 4)
        assert not set(active.views) & set(blind)


def test_the_block_that_shares_least_with_those_that_are_out_is_next(make):
    run = make(blocks=4, steps=80)
    first = run.visits.begin(at_once=2)
    queued = [plan.block for plan in run.state.queue]
    everywhere, elsewhere = {0: 0.5, 1: 0.5}, {2: 0.1, 3: 0.1}
    blocks = (first.geometry.block, *queued)
    run.state.influence = {block: elsewhere if block == queued[-1] else everywhere for block in blocks}
    run.state.in_flight.append(first)
    assert run.visits.begin(at_once=2).geometry.block == queued[-1]
    run.state.in_flight.clear()
    assert run.visits.begin().geometry.block == queued[0]  # one at a time goes by the epoch's order


def test_a_block_looks_at_a_doubtful_view_that_sees_it(grown, monkeypatch):
    coordinator = grown()
    blindfold(coordinator, monkeypatch, blind=(1, 2, 4))
    coordinator.state.influence = {block: {0: 0.1} for block in range(4)}
    active = coordinator.visits.begin()
    assert active.views == (0, 3)
    assert active.looked_at == (3,)


def test_a_block_that_a_wall_hides_is_neither_read_nor_drawn(tmp_path, monkeypatch):
    y, z = torch.cartesian_prod(*[torch.linspace(-2, 2, 20)] * 2).unbind(1)
    places = torch.stack((torch.zeros_like(y), y, z), dim=1)
    wall = cloud_from_points(places, torch.zeros_like(places), sh_degree=1).gaussians()
    wall.opacities.fill_(6.0), wall.scales.add_(0.7)
    before, behind = random_gaussians(200, size=0.05), random_gaussians(600, seed=1, size=0.05)
    before.means[:, 0] += 2.0
    behind.means[:, 0] -= 8.0
    eyes = (6.0, -0.4, 0.0), (6.0, 0.4, 0.0)
    views = [camera(eye, (0.0, 0.0, 0.1), index, (48, 36), focal=2.0) for index, eye in enumerate(eyes)]
    scene = Gaussians.cat([wall, before, behind])
    run = make_coordinator(tmp_path, scene, views, blocks=8, window_weight=0.0)
    hidden = {block for block in range(8) if float(run.scene.gaussians(block).means[:, 0].max()) < -5}
    whole = whole_scene(run)
    known = influence(whole, run.scene.tree.assign(whole.means), views, run.run.rasterizer)
    run.state.influence = {block: known.get(block, {}) for block in range(8)}
    read, drawn = set[int](), run.scene.drawn
    monkeypatch.setattr(run.scene, "drawn", lambda block, *more: read.add(block) or drawn(block, *more))
    for _ in range(8):
        read.clear()
        batch = run.next_batch()
        assert read == set(range(8)) - hidden - {run.state.active.geometry.block}
        rendered = run.render(batch)
        assert all(float(off.mean()) < 5e-4 for off in off_from_merged(run, batch, rendered.pictures))
        run.end_visit()
    assert len(hidden) == 4


def test_layers_tell_the_influence_that_one_drawing_of_the_scene_does(make, views):
    coordinator = make(blocks=5, steps=1)
    scene, run = coordinator.scene, coordinator.run
    whole = whole_scene(coordinator)
    wanted = influence(whole, scene.tree.assign(whole.means), views, run.rasterizer)
    found = influence_by_layers(run, scene)
    assert found.keys() == wanted.keys()
    for block, shares in wanted.items():  # a Gaussian at a border is shared there by its fragments
        assert sum(found[block].values()) == pytest.approx(sum(shares.values()), rel=0.1)
    for view in views:  # what they leave of the light is the same
        both = [sum(shares.get(view.index, 0.0) for shares in each.values()) for each in (found, wanted)]
        assert both[0] == pytest.approx(both[1], rel=1e-3)


def test_where_no_influence_is_known_no_view_is_doubtful(tmp_path):
    """With so many views that a sample of means tells which see a block: some show its edge alone."""
    aside = [camera((4.0, 0.0, 0.0), (0.0, 3.5, 0.01 * index), index, (24, 18)) for index in range(120)]
    views = [view if view.index % 2 else replace(view, viewmat=ring_of_views(1)[0].viewmat) for view in aside]
    run = make_coordinator(tmp_path, random_gaussians(200, size=0.3), views, blocks=2, steps=400)
    for _ in range(2):
        run.next_batch()
        assert run.state.active.looked_at == ()
        run.end_visit()
    assert run.state.influence == {}
