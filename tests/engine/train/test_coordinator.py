"""Visits: gradients, nothing lost, exact resumption, one block is plain 3DGS; scenes of all kinds."""

import math
from dataclasses import replace

import pytest
import torch

from abcd_ns.engine.events import EpochEnded, LayersDrawn, StepTaken, VisitBegan, VisitEnded
from abcd_ns.engine.gaussians.initialize import cloud_from_points
from abcd_ns.engine.layers.compositing import composite, fold
from abcd_ns.engine.space.partition import build_kd
from abcd_ns.engine.space.tree import front_to_back
from abcd_ns.engine.store.commit import with_pending
from abcd_ns.engine.store.special_blocks import ACTIVE, PENDING, WHOLE
from abcd_ns.engine.train.density.control import DensityConfig
from abcd_ns.engine.train.health import unsound
from abcd_ns.engine.train.run_state import BlockHealth, Budget, RunState
from abcd_ns.engine.train.schedule import VisitPlan
from abcd_ns.engine.train.training_loop import train, train_step
from abcd_ns.engine.types import Gaussians
from tests.reference.plain_3dgs import train_plain
from tests.reference.rasterizer_scenes import as_leaves, drawn
from tests.reference.scenes import (
    GROWING,
    STILL,
    UNPRUNED,
    Photos,
    assert_resumes,
    equal,
    listen,
    make_coordinator,
    random_gaussians,
    ring_of_views,
    steps_of,
    whole_scene,
)


@pytest.mark.parametrize(("growing", "layers"), [(True, True), (False, False)], ids=["growing", "ablated"])
def test_one_block_is_plain_3dgs_bit_for_bit(make, views, photos, start, growing, layers):
    density = UNPRUNED if growing else STILL
    coordinator = make(blocks=1, steps=40, density=density, layers=layers, fast_start=True)
    train(coordinator, photos)
    expected = train_plain(start, views, photos, steps=40, config=coordinator.config)
    assert (len(expected) != len(start)) == growing
    assert equal(whole_scene(coordinator), expected)


@pytest.mark.parametrize(
    ("ownership", "primitive"), [("fragments", "3dgs"), ("fragments", "2dgs"), ("means", "3dgs")]
)
def test_the_blocks_gradient_is_that_of_the_whole_picture(make, ownership, primitive):
    """Through kept F and B == through a render of all blocks at once (invariant 3), in float64."""
    start = random_gaussians(100, size=0.08, dtype=torch.float64)
    views = ring_of_views(3, dtype=torch.float64)
    options = {"ownership": ownership, "primitive": primitive, "density": STILL, "batch": 1}
    coordinator = make(start=start, views=views, blocks=4, window_weight=0.0, **options)
    for _ in range(3):
        batch = coordinator.next_batch()
        (sample,) = batch.samples
        weights = torch.rand(sample.crop.height, sample.crop.width, 3, dtype=torch.float64)
        sample = replace(sample, background=torch.rand(3, dtype=torch.float64))
        rendered = coordinator.render(replace(batch, samples=(sample,)))
        (weights * rendered.pictures[0]).sum().backward()
        expected = gradient_of_whole_picture(coordinator, sample, weights, ownership)
        for name, gradient in expected.items():
            atol = 1e-10 * float(gradient.abs().max())
            assert torch.allclose(coordinator.params[name].grad, gradient, rtol=1e-9, atol=atol), name
        for optimizer in coordinator.optimizers.values():
            optimizer.zero_grad()
        coordinator.after_step(rendered)


def gradient_of_whole_picture(coordinator, sample, weights, ownership) -> dict[str, torch.Tensor]:
    """By autograd through one render of everything (fragments) or through the fold of all blocks (means)."""
    draw, tree = coordinator.run.rasterizer, coordinator.scene.tree
    block, options = coordinator.state.active.geometry.block, {"crop": sample.crop}
    options["sh_degree"] = coordinator.run.active.sh_degree
    blocks = {b: coordinator.scene.gaussians(b) for b in range(tree.num_blocks)}
    active = as_leaves(blocks[block])
    if ownership == "fragments":
        others = Gaussians.cat([g for b, g in blocks.items() if b != block])
        layer = drawn(draw, active, sample.view, frozen=others, **options).layer
    else:
        parts = {**blocks, block: active}
        order = front_to_back(tree, sample.view.center)
        layer = fold([draw(parts[b], sample.view, **options).layer for b in order])
    (weights * composite(layer, sample.background).clamp(0, 1)).sum().backward()
    return {name: value.grad for name, value in active.items()}


def test_nothing_is_lost_when_gaussians_migrate(make, photos, start):
    coordinator = make(blocks=8, steps=60, density=STILL)
    generator = torch.Generator().manual_seed(0)
    ended = listen(coordinator, VisitEnded)
    for _ in steps_of(coordinator, photos):
        means = coordinator.params["means"].detach()
        means += 0.05 * torch.randn(means.shape, generator=generator)
        assert coordinator.count() == len(start)
        if coordinator.state.active is None:
            for b in range(8):
                means = with_pending(coordinator.scene, b).gaussians.means
                assert bool((coordinator.scene.tree.assign(means) == b).all())
    assert sum(event.migrated for event in ended) > 0


def test_migrants_take_their_moments_along(make, photos):
    coordinator = make(blocks=2, steps=30, density=STILL, batch=2)
    while coordinator.state.active is None or coordinator.run.active.done < coordinator.run.active.steps - 1:
        train_step(coordinator, photos)
    other = 1 - coordinator.run.active.geometry.block
    coordinator.params["means"].detach()[0] = coordinator.scene.gaussians(other).means[0]
    moments = coordinator.optimizers["scales"].state[coordinator.params["scales"]]["exp_avg"]
    row = coordinator.params["scales"][0].detach().clone()
    arrived_before, stored = coordinator.scene.count(other), coordinator.scene.state(other)
    train_step(coordinator, photos)
    assert equal(coordinator.scene.state(other).gaussians, stored.gaussians)
    arrived = with_pending(coordinator.scene, other)
    assert len(arrived) == coordinator.scene.count(other) == arrived_before + 1
    assert equal(coordinator.scene.gaussians(other), arrived.gaussians)
    assert torch.allclose(arrived.gaussians.scales[-1], row, atol=0.02)
    assert torch.allclose(arrived.exp_avg.scales[-1], moments[0], atol=1e-3)
    assert float(arrived.exp_avg.scales[-1].abs().max()) > 0


@pytest.mark.parametrize(("blocks", "stops"), [(1, (14,)), (4, (3, 22))])
def test_a_run_that_stops_and_goes_on_is_the_run_that_did_not(make, photos, blocks, stops):
    """In the middle of a visit, with densification, and with layers of which some have no room."""
    options = {"blocks": blocks, "steps": 30, "density": GROWING, "layer_bytes": 60_000}
    _, resumed = assert_resumes(make, photos, *stops, **options)
    store = resumed.scene.store
    assert ACTIVE not in store.blocks or store.counts(ACTIVE) == 0


def test_blocks_that_no_view_sees_are_left_alone(make, photos, start):
    start.means[:20] += 50.0
    coordinator = make(blocks=8, steps=40)
    blocks = {block: coordinator.scene.gaussians(block) for block in range(8)}
    unseen = {block: before for block, before in blocks.items() if bool((before.means > 40).all())}
    assert unseen
    begun = listen(coordinator, VisitBegan)
    train(coordinator, photos)
    assert not {event.block for event in begun} & unseen.keys()
    assert all(coordinator.state.views[block] == 0 for block in unseen)
    assert all(equal(coordinator.scene.gaussians(block), before) for block, before in unseen.items())


def test_a_block_that_no_view_saw_is_visited_once_others_have_come_into_it(make, photos):
    coordinator = make(blocks=3, steps=60)
    unseen = (coordinator.visits.begin().geometry.block + 1) % 3
    coordinator.state.views[unseen] = 0
    coordinator.state.active = None
    coordinator.state.queue.clear()
    come = coordinator.scene.state(unseen)[:3]
    coordinator.run.persist(coordinator.scene.tree, {PENDING: come}, within=0.0)
    assert coordinator.scene.pending_for(unseen) is not None
    begun = listen(coordinator, VisitBegan, lambda event: event.block)
    train(coordinator, photos)
    assert unseen in begun
    assert coordinator.state.views[unseen] > 0


def test_events_tell_the_whole_story(make, photos):
    coordinator = make(blocks=3, steps=45)
    events = listen(coordinator, object)
    train(coordinator, photos)
    kinds = [type(e) for e in events]
    begun = [e for e in events if isinstance(e, VisitBegan)]
    assert kinds.count(StepTaken) == 45 == sum(e.steps for e in begun)
    assert kinds.count(VisitBegan) == kinds.count(VisitEnded) == coordinator.state.visit
    assert kinds.count(EpochEnded) == coordinator.state.epoch + 1
    assert {e.block for e in begun} == {0, 1, 2}
    for visit in begun:
        drawn = [e for e in events if isinstance(e, LayersDrawn) and e.visit == visit.visit]
        assert list(dict.fromkeys(e.done for e in drawn)) == list(range(drawn[-1].total + 1))
        assert drawn[-1].total == min(visit.views, visit.steps * coordinator.batch)


def test_a_limit_on_gaussians_is_kept_at_every_step(make, photos, start):
    limit = len(start) + 15
    density = replace(UNPRUNED, max_gaussians=limit, cull_alpha_thresh=0.0)
    coordinator = make(blocks=2, steps=60, density=density)
    counts = [coordinator.count() for _ in steps_of(coordinator, photos)]
    assert len(start) < counts[-1] <= max(counts) <= limit


def test_a_run_whose_time_runs_out_within_a_visit_ends_that_visit(make, photos):
    """Seconds pass between any two looks at the clock."""
    coordinator = make(blocks=2, steps=60)
    train(coordinator, photos, steps=3)
    assert coordinator.state.active is not None
    coordinator.run.budget = Budget(steps=3)
    assert not coordinator.finished
    train(coordinator, photos)
    assert coordinator.finished
    assert coordinator.state.active is None
    assert coordinator.state.step == 4


def test_a_scene_that_no_view_sees_is_an_error_that_says_so(make, photos, start):
    start.means[:] += 1000.0
    with pytest.raises(RuntimeError, match="no training view sees any Gaussian"):
        train_step(make(blocks=2), photos)


def test_the_state_of_a_run_survives_json(make, photos):
    coordinator = make(blocks=4, steps=50)
    train(coordinator, photos, steps=7)
    state = coordinator.state
    state.health |= {WHOLE: BlockHealth(gradients=3), 4: BlockHealth(visits=2, hidden=True)}
    state.influence = {0: {2: 0.5}}
    state.active.looked_at = (2,)
    again = RunState.from_json({**state.to_json(), "warm": 0.35})  # as before 2026-11-24
    assert again.to_json() == state.to_json()
    assert (again.health, again.influence, again.queue) == (state.health, state.influence, state.queue)
    assert again.active.looked_at == (2,)
    assert again.active.geometry.crops == state.active.geometry.crops
    assert RunState.from_json({"queue": [[3, 10]]}).queue == [VisitPlan(3, 10)]  # before plans had a batch


def off_from_merged(coordinator, batch, pictures) -> list[torch.Tensor]:
    """How far pictures are from those of the whole scene, drawn at once."""
    draw, scene = coordinator.run.rasterizer, whole_scene(coordinator).detach()
    degree, found = coordinator.run.active.sh_degree, []
    for sample, picture in zip(batch.samples, pictures, strict=True):
        layer = draw(scene, sample.view, sh_degree=degree, crop=sample.crop).layer
        found.append((picture.detach() - composite(layer, sample.background).clamp(0, 1)).abs())
    return found


def test_an_oversized_gaussian_is_trained_where_it_reaches_out_of_its_cell(make, start):
    """Drawn behind what it hides, it would learn nothing there, and spoil the picture unseen."""
    start.scales[3] = math.log(0.7)
    start.opacities[3] = 2.0
    coordinator = make(blocks=4, visit_steps=1)
    owner, seen = int(coordinator.scene.tree.assign(start.means[3:4])), 0
    for _ in range(4):
        batch = coordinator.next_batch()
        if coordinator.state.active.geometry.block == owner:
            for off in off_from_merged(coordinator, batch, coordinator.render(batch).pictures):
                assert float(off.mean()) < 1e-3
                seen += 1
        coordinator.end_visit()
    assert seen > 0


def test_layers_show_what_earlier_visits_made_of_the_other_blocks(make, photos):
    """Invariant 6: whenever a visit begins, its pictures are those of the whole scene as it is by then."""
    coordinator = make(blocks=4, window_weight=0.0, visit_steps=2)
    begun = 0
    while not coordinator.finished:
        batch = coordinator.next_batch()
        if coordinator.run.active.done == 0:
            begun += 1
            for off in off_from_merged(coordinator, batch, coordinator.render(batch).pictures):
                assert float(off.max()) < 1e-3  # of half floats
        train_step(coordinator, photos)
    assert begun > 4


# Scenes that no capture should be, and some are


def test_pictures_of_any_size_train_together(tmp_path):
    sizes = ((1, 1), (7, 5), (33, 17), (101, 67), (48, 36), (16, 64))
    rings = [ring_of_views(len(sizes), width=width, height=height) for width, height in sizes]
    views = [ring[index] for index, ring in enumerate(rings)]
    photos = Photos(random_gaussians(60, seed=7, size=0.1), views)
    start, density = random_gaussians(60, seed=1, size=0.08), DensityConfig(refine_start=0.0)
    coordinator = make_coordinator(tmp_path, start, views, steps=24, density=density)
    train(coordinator, photos)
    assert not bool(unsound(whole_scene(coordinator)).any())


def test_a_block_inside_an_opaque_ball_is_visited_once_and_then_passed_over(tmp_path):
    draw = {"generator": torch.Generator().manual_seed(1)}
    shell = 0.5 * torch.nn.functional.normalize(torch.randn((900, 3), **draw), dim=1)
    wall = cloud_from_points(shell, torch.full((900, 3), 128.0), sh_degree=1).gaussians()
    wall.scales.fill_(math.log(0.08))
    wall.opacities.fill_(8.0)
    middle = 0.02 * torch.randn((30, 3), **draw)
    inside = cloud_from_points(middle, torch.full((30, 3), 255.0), sh_degree=1).gaussians()
    tree, origin = build_kd(torch.zeros(0, 3), 1), torch.zeros(1, 3)
    for axis in range(3):
        for at in (-0.2, 0.2):
            tree = tree.split(int(tree.assign(origin)), axis, at)
    core, views = int(tree.assign(origin)), ring_of_views(6, width=24, height=18)
    options = {"tree": tree, "warmup": 0.0, "passes": 1, "density": DensityConfig(strategy="off")}
    coordinator = make_coordinator(tmp_path, Gaussians.cat([wall, inside]), views, steps=10_000, **options)
    photos = Photos(wall, views)
    while coordinator.state.epoch < 2:
        train_step(coordinator, photos)
    assert coordinator.state.health[core].hidden
    assert coordinator.scene.clocks(core).visits == 1
