"""Visits: gradients, nothing lost, exact resumption, and that one block is plain 3DGS."""

import dataclasses
import math

import pytest
import torch

from abcd_ns.engine.events import LayersDrawn, StepTaken, SweepEnded, VisitBegan, VisitEnded
from abcd_ns.engine.layers.compositing import composite, fold
from abcd_ns.engine.render.cpu.backend import TorchRasterizer
from abcd_ns.engine.space.ordering import front_to_back
from abcd_ns.engine.store.settle import with_mail
from abcd_ns.engine.store.special_blocks import INBOX, LIVE
from abcd_ns.engine.train.density.control import DensityConfig
from abcd_ns.engine.train.run_state import Budget, RunState
from abcd_ns.engine.train.training_loop import train, train_step
from abcd_ns.engine.types import Gaussians
from tests.reference.plain_3dgs import train_plain
from tests.reference.scenes import (
    equal,
    listen,
    make_coordinator,
    random_gaussians,
    ring_of_views,
    whole_scene,
)

GROWING = DensityConfig(refine_start=0.0, refine_every=5, split_pixels=0.0)


BOTH = pytest.mark.parametrize("primitive", ["3dgs", "2dgs"])


@BOTH
def test_training_improves_every_photo(tmp_path, views, photos, start, primitive):
    options = {"steps": 120, "background": "black", "primitive": primitive}
    coordinator = make_coordinator(tmp_path, start, views, blocks=4, **options)

    def error() -> list[float]:
        draw = coordinator.run.rasterizer
        scene = whole_scene(coordinator)
        with torch.no_grad():
            pictures = [draw(scene, v, sh_degree=1).color.clamp(0, 1) for v in views]
        return [
            float((p - photos.images[v.index]).square().mean()) for p, v in zip(pictures, views, strict=True)
        ]

    before = error()
    train(coordinator, photos)
    assert coordinator.state.step == 120
    assert all(new < 0.8 * old for old, new in zip(before, error(), strict=True)), (before, error())


@pytest.mark.parametrize("growing", [False, True])
def test_one_block_is_plain_3dgs_bit_for_bit(tmp_path, views, photos, start, growing):
    density = dataclasses.replace(GROWING, price=0.0) if growing else DensityConfig(strategy="off")
    options = {"blocks": 1, "steps": 40, "density": density, "fast_start": True}
    coordinator = make_coordinator(tmp_path, start, views, **options)
    train(coordinator, photos)
    expected = train_plain(start, views, photos, steps=40, config=coordinator.config)
    assert len(expected) != len(start) or not growing
    assert equal(whole_scene(coordinator), expected)


def test_ablated_with_one_block_is_the_same_too(tmp_path, views, photos, start):
    results = []
    for layers in (True, False):
        folder = tmp_path / str(layers)
        folder.mkdir()
        coordinator = make_coordinator(folder, start, views, blocks=1, steps=12, layers=layers)
        train(coordinator, photos)
        results.append(whole_scene(coordinator))
    assert equal(*results)


@pytest.mark.parametrize("ownership", ["fragments", "means"])
@BOTH
def test_the_blocks_gradient_is_that_of_the_whole_picture(tmp_path, ownership, primitive):
    """Through kept F and B == through a render of all blocks at once (invariant 3), in float64."""
    gaussians = random_gaussians(100, size=0.08, dtype=torch.float64)
    views = ring_of_views(3, dtype=torch.float64)
    still = DensityConfig(strategy="off")
    coordinator = make_coordinator(
        tmp_path,
        gaussians,
        views,
        blocks=4,
        ownership=ownership,
        window_weight=0.0,
        density=still,
        batch=1,
        primitive=primitive,
    )
    for _ in range(3):
        batch = coordinator.next_batch()
        (sample,) = batch.samples
        weights = torch.rand(sample.crop.height, sample.crop.width, 3, dtype=torch.float64)
        sample = dataclasses.replace(sample, background=torch.rand(3, dtype=torch.float64))
        rendered = coordinator.render(dataclasses.replace(batch, samples=(sample,)))
        (weights * rendered.pictures[0]).sum().backward()
        block = coordinator.state.active.geometry.block
        found = {name: p.grad.clone() for name, p in coordinator.params.items()}
        expected = _gradient_of_whole_picture(coordinator, sample, weights, block, ownership)
        for name, gradient in expected.items():
            atol = 1e-10 * float(gradient.abs().max())
            assert torch.allclose(found[name], gradient, rtol=1e-9, atol=atol), name
        for optimizer in coordinator.optimizers.values():
            optimizer.zero_grad()
        coordinator.after_step(rendered)


def _gradient_of_whole_picture(coordinator, sample, weights, block, ownership) -> dict[str, torch.Tensor]:
    """By autograd through one render of everything (fragments) or through the fold of all blocks (means)."""
    draw, tree = coordinator.run.rasterizer, coordinator.scene.tree
    blocks = {b: coordinator.scene.gaussians(b) for b in range(tree.num_blocks)}
    active = Gaussians(**{n: v.clone().requires_grad_() for n, v in blocks[block].items()})
    degree = coordinator.run.active.sh_degree
    if ownership == "fragments":
        others = Gaussians.cat([g for b, g in blocks.items() if b != block])
        layer = draw(active, sample.view, sh_degree=degree, crop=sample.crop, frozen=others).layer
        picture = composite(layer, sample.background)
    else:
        order = front_to_back(tree, sample.view.center)
        parts = {**blocks, block: active}
        picture = composite(
            fold([draw(parts[b], sample.view, sh_degree=degree, crop=sample.crop).layer for b in order]),
            sample.background,
        )
    (weights * picture.clamp(0, 1)).sum().backward()
    return {name: value.grad for name, value in active.items()}


@pytest.mark.parametrize("blocks", [1, 3, 8])
def test_nothing_is_lost_when_gaussians_migrate(tmp_path, views, photos, start, blocks):
    """Means are thrown about; each Gaussian keeps its own colour, by which it is found again."""
    coordinator = make_coordinator(
        tmp_path, start, views, blocks=blocks, steps=60, density=DensityConfig(strategy="off")
    )
    generator = torch.Generator().manual_seed(0)
    total = len(start)
    moved = 0

    def count_moved(event) -> None:
        nonlocal moved
        if isinstance(event, VisitEnded):
            moved += event.migrated

    coordinator.announce.subscribe(count_moved)
    while not coordinator.finished:
        train_step(coordinator, photos)
        with torch.no_grad():
            noise = torch.randn(coordinator.params["means"].shape, generator=generator)
            coordinator.params["means"].add_(0.05 * noise)
        assert coordinator.count() == total
        if coordinator.state.active is None:
            for b in range(coordinator.scene.tree.num_blocks):
                means = with_mail(coordinator.scene, b).gaussians.means
                assert bool((coordinator.scene.tree.assign(means) == b).all())
    assert (moved > 0) == (blocks > 1)


def test_migrants_take_their_moments_along(tmp_path, views, photos, start):
    coordinator = make_coordinator(
        tmp_path, start, views, blocks=2, steps=30, density=DensityConfig(strategy="off"), batch=2
    )
    while coordinator.state.active is None or coordinator.run.active.done < coordinator.run.active.steps - 1:
        train_step(coordinator, photos)
    block = coordinator.run.active.geometry.block
    with torch.no_grad():
        coordinator.params["means"][0] = coordinator.scene.gaussians(1 - block).means[0]
    moments = coordinator.optimizers["scales"].state[coordinator.params["scales"]]["exp_avg"]
    row = coordinator.params["scales"][0].detach().clone()
    arrived_before, at_rest = coordinator.scene.count(1 - block), coordinator.scene.state(1 - block)
    train_step(coordinator, photos)
    assert equal(coordinator.scene.state(1 - block).gaussians, at_rest.gaussians)
    arrived = with_mail(coordinator.scene, 1 - block)
    assert len(arrived) == coordinator.scene.count(1 - block) == arrived_before + 1
    assert equal(coordinator.scene.gaussians(1 - block), arrived.gaussians)
    assert torch.allclose(arrived.gaussians.scales[-1], row, atol=0.02)
    assert torch.allclose(arrived.exp_avg.scales[-1], moments[0], atol=1e-3)
    assert float(arrived.exp_avg.scales[-1].abs().max()) > 0


@pytest.mark.parametrize("blocks", [1, 4])
def test_a_run_that_stops_and_goes_on_is_the_run_that_did_not(tmp_path, views, photos, start, blocks):
    """Bit for bit, in the middle of a visit too (invariant 7), with densification, and with layers of which
    some have no room."""
    options = {"steps": 30, "density": GROWING, "layer_bytes": 60_000}
    (tmp_path / "whole").mkdir()
    whole = make_coordinator(tmp_path / "whole", start, views, blocks=blocks, **options)
    train(whole, photos)
    live, within_visits = LIVE, 0
    for stop in (3, 14, 22):
        folder = tmp_path / str(stop)
        folder.mkdir()
        stopped = make_coordinator(folder, start, views, blocks=blocks, **options)
        train(stopped, photos, steps=stop)
        active = stopped.state.active
        within_visits += active is not None and active.done > 0
        stopped.save()
        stopped.save(pin="here")
        stopped.scene.store.close()
        went_on = make_coordinator(folder, start, views, resume=True, **options)
        assert went_on.state.step == stop
        train(went_on, photos)
        assert went_on.state.step == 30
        assert equal(whole_scene(went_on), whole_scene(whole))
        assert live not in went_on.scene.store.blocks or went_on.scene.store.counts(live) == 0
    assert within_visits > 0


def test_the_same_seed_gives_the_same_run_and_another_another(tmp_path, views, photos, start):
    results = []
    for number, seed in enumerate((0, 0, 1)):
        folder = tmp_path / str(number)
        folder.mkdir()
        coordinator = make_coordinator(folder, start, views, blocks=3, steps=25, density=GROWING, seed=seed)
        train(coordinator, photos)
        results.append(whole_scene(coordinator))
    assert equal(results[0], results[1])
    assert not equal(results[0], results[2])


def test_blocks_that_no_view_sees_are_left_alone(tmp_path, views, photos, start):
    start.means[:20] += 50.0
    coordinator = make_coordinator(tmp_path, start, views, blocks=8, steps=60)
    unseen = [b for b in range(8) if bool((coordinator.scene.gaussians(b).means > 40).all())]
    assert unseen
    before = [coordinator.scene.gaussians(b) for b in unseen]
    begun = listen(coordinator, VisitBegan)
    train(coordinator, photos)
    assert not {event.block for event in begun} & set(unseen)
    assert all(coordinator.state.views[b] == 0 for b in unseen)
    assert all(equal(coordinator.scene.gaussians(b), g) for b, g in zip(unseen, before, strict=True))


def test_a_block_that_no_view_saw_is_visited_once_others_have_come_into_it(tmp_path, views, photos, start):
    coordinator = make_coordinator(tmp_path, start, views, blocks=3, steps=60)
    first = coordinator.visits.begin().geometry.block
    unseen = (first + 1) % 3
    coordinator.state.views[unseen] = 0
    coordinator.state.active = None
    coordinator.state.queue.clear()
    come = coordinator.scene.state(unseen)[:3]
    coordinator.run.rest(coordinator.scene.tree, {INBOX: come}, within=0.0)
    assert coordinator.scene.mail(unseen) is not None
    begun = listen(coordinator, VisitBegan)
    train(coordinator, photos)
    assert unseen in {event.block for event in begun}
    assert coordinator.state.views[unseen] > 0


def test_events_tell_the_whole_story(tmp_path, views, photos, start):
    coordinator = make_coordinator(tmp_path, start, views, blocks=3, steps=45)
    events = []
    coordinator.announce.subscribe(events.append)
    train(coordinator, photos)
    kinds = [type(e) for e in events]
    begun = [e for e in events if isinstance(e, VisitBegan)]
    assert kinds.count(StepTaken) == 45 == sum(e.steps for e in begun)
    assert kinds.count(VisitBegan) == kinds.count(VisitEnded) == coordinator.state.visit
    assert kinds.count(SweepEnded) == coordinator.state.sweep + 1
    assert {e.block for e in begun} == {0, 1, 2}
    for visit in begun:
        drawn = [e for e in events if isinstance(e, LayersDrawn) and e.visit == visit.visit]
        assert [e.done for e in drawn] == list(range(1, len(drawn) + 1))
        assert len(drawn) == min(visit.views, visit.steps * coordinator.batch)


def test_a_limit_on_gaussians_is_kept_at_every_step(tmp_path, views, photos, start):
    limit = len(start) + 15
    density = dataclasses.replace(GROWING, max_gaussians=limit, cull_alpha_thresh=0.0, price=0.0)
    coordinator = make_coordinator(tmp_path, start, views, blocks=2, steps=60, density=density)
    counts = []
    while not coordinator.finished:
        train_step(coordinator, photos)
        counts.append(coordinator.count())
    assert max(counts) <= limit
    assert counts[-1] > len(start)


def test_a_run_whose_time_runs_out_within_a_visit_ends_that_visit(tmp_path, views, photos, start):
    """Seconds pass between any two looks at the clock."""
    coordinator = make_coordinator(tmp_path, start, views, blocks=2, steps=60)
    train(coordinator, photos, steps=3)
    assert coordinator.state.active is not None
    coordinator.run.budget = Budget(steps=3)
    assert not coordinator.finished
    train(coordinator, photos)
    assert coordinator.finished
    assert coordinator.state.active is None
    assert coordinator.state.step == 4


def test_a_scene_that_no_view_sees_is_an_error_that_says_so(tmp_path, views, photos, start):
    start.means[:] += 1000.0
    coordinator = make_coordinator(tmp_path, start, views, blocks=2)
    with pytest.raises(RuntimeError, match="no training view sees any Gaussian"):
        train_step(coordinator, photos)


def test_the_state_of_a_run_survives_json(tmp_path, views, photos, start):
    coordinator = make_coordinator(tmp_path, start, views, blocks=4, steps=50)
    train(coordinator, photos, steps=7)
    state = coordinator.state
    again = RunState.from_json({**state.to_json(), "warm": 0.35})  # as before 2026-11-24
    assert again.to_json() == state.to_json()
    assert again.active.geometry.crops == state.active.geometry.crops


@pytest.mark.parametrize("pass_gaussians", [0, 30])
@BOTH
def test_the_sandwich_of_a_sample_is_the_merged_picture(tmp_path, views, start, pass_gaussians, primitive):
    """What a step sees of the scene, before any training, is what a viewer would see."""
    start, views = start.to(torch.float64), [view.to(torch.float64) for view in views]
    options = {"window_weight": 0.0, "pass_gaussians": pass_gaussians, "primitive": primitive}
    coordinator = make_coordinator(tmp_path, start, views, blocks=4, **options)
    draw = coordinator.run.rasterizer
    scene = whole_scene(coordinator)
    for _ in range(4):
        batch = coordinator.next_batch()
        assert 1 < len(batch.samples) <= coordinator.batch
        with torch.no_grad():
            rendered = coordinator.render(batch)
        for sample, picture in zip(batch.samples, rendered.pictures, strict=True):
            with torch.no_grad():
                layer = draw(scene, sample.view, sh_degree=0, crop=sample.crop).layer
            expected = composite(layer, sample.background).clamp(0, 1)
            assert float((picture - expected).abs().max()) < 1e-9
            assert sample.layers is not None
        coordinator.after_step(rendered)


def test_a_giant_is_trained_where_it_reaches_out_of_its_cell(tmp_path, views, start):
    """Drawn behind what it hides, it would learn nothing there, and spoil the picture unseen."""
    start.scales[3] = math.log(0.7)
    start.opacities[3] = 2.0
    coordinator = make_coordinator(tmp_path, start, views, blocks=4, visit_steps=1)
    scene, tree = whole_scene(coordinator), coordinator.scene.tree
    owner, draw, seen = int(tree.assign(start.means[3:4])), TorchRasterizer(), 0
    for _ in range(4):
        batch = coordinator.next_batch()
        if coordinator.state.active.geometry.block == owner:
            with torch.no_grad():
                pictures = coordinator.render(batch).pictures
            for sample, picture in zip(batch.samples, pictures, strict=True):
                layer = draw(scene, sample.view, sh_degree=0, crop=sample.crop).layer
                merged = layer.color + layer.transmittance[..., None] * sample.background
                assert float((picture - merged.clamp(0, 1)).abs().mean()) < 1e-3
                seen += 1
        coordinator.end_visit()
    assert seen > 0


def test_layers_show_what_earlier_visits_made_of_the_other_blocks(tmp_path, views, photos, start):
    """Invariant 6: whenever a visit begins, its pictures are those of the whole scene as it is by then."""
    coordinator = make_coordinator(tmp_path, start, views, blocks=4, window_weight=0.0, visit_steps=2)
    draw, render, begun = TorchRasterizer(), coordinator.render, 0

    def compared(batch):
        nonlocal begun
        rendered = render(batch)
        if coordinator.run.active.done > 0:
            return rendered
        begun, scene, degree = begun + 1, whole_scene(coordinator).detach(), coordinator.run.active.sh_degree
        for sample, picture in zip(batch.samples, rendered.pictures, strict=True):
            layer = draw(scene, sample.view, sh_degree=degree, crop=sample.crop).layer
            expected = composite(layer, sample.background).clamp(0, 1)
            assert float((picture.detach() - expected).abs().max()) < 1e-3  # of half floats
        return rendered

    coordinator.render = compared
    train(coordinator, photos)
    assert begun > 4
