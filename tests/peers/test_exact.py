"""Exact joint training over blocks: gradients and steps are those of one drawing of everything."""

from dataclasses import replace

import pytest
import torch

from abcd_ns.engine.gaussians.param_swap import rates_of_under_trained
from abcd_ns.engine.layers.compositing import composite
from abcd_ns.engine.store.special_blocks import ACTIVE
from abcd_ns.engine.train.coordinator import Coordinator
from abcd_ns.engine.train.training_loop import train, train_step
from abcd_ns.engine.types import Gaussians
from abcd_ns.errors import UserError
from abcd_ns.peers.exact import ExactTrainer
from tests.reference.scenes import GROWING, STILL, Photos, random_gaussians, ring_of_views, stop, whole_scene


@pytest.fixture
def exact(make):
    """Makes such runs, of `scene` unless told otherwise."""
    given = {"kind": ExactTrainer, "density": STILL, "start": scene(torch.float32)}
    return lambda *args, **options: make(*args, **{**given, **options})


def scene(dtype) -> Gaussians:
    """So thin that no pixel reaches T <= 1e-4, where drawing stops; that layers do by themselves."""
    gaussians = random_gaussians(150, seed=1, size=0.12, dtype=dtype)
    gaussians.opacities[:] -= 2.5
    return gaussians


def by_rotation(gaussians: Gaussians) -> Gaussians:
    """In an order that does not depend on blocks; rotations are all different and hardly change."""
    return gaussians[gaussians.quats[:, 0].argsort()]


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-10), (torch.float32, 1e-5)])
def test_gradients_are_those_of_the_merged_picture(exact, dtype, tolerance):
    views, start = ring_of_views(3, dtype=dtype), scene(dtype)
    photos = Photos(random_gaussians(150, seed=7, size=0.12, dtype=dtype), views)
    coordinator = exact(start=start, views=views, blocks=5, batch=2, sh_ramp=0.0)
    batch = coordinator.next_batch()
    wanted = [photos(sample.view.index, sample.crop) for sample in batch.samples]
    coordinator.loss(batch, coordinator.render(batch).pictures, wanted).backward()
    found = coordinator.gradients()

    leaves = whole_scene(coordinator)
    leaves = Gaussians(**{name: value.clone().requires_grad_() for name, value in leaves.items()})
    pictures = []
    for sample in batch.samples:
        raster = coordinator.run.rasterizer(leaves, sample.view, sh_degree=1)
        pictures.append(composite(raster.layer, sample.background).clamp(0, 1))
    coordinator.loss(batch, pictures, wanted).backward()
    order = coordinator.scene.tree.assign(coordinator._all.gaussians.means).argsort(stable=True)
    for name, leaf in leaves.items():
        worst = float((found.params[name][order] - leaf.grad).abs().max())
        assert worst <= tolerance * float(leaf.grad.abs().max()), name


def test_reduced_pictures_are_exact_too(exact, monkeypatch):
    """A pixel of theirs is as much wider, and what lies beyond a cell's border may still show within."""
    monkeypatch.setattr("abcd_ns.engine.train.schedule.LEAST_SIDE", 1)
    start = scene(torch.float64)
    start.scales[:] -= 3.0  # it is the blur that reaches over borders
    coordinator = exact(start=start, views=ring_of_views(3, dtype=torch.float64), blocks=5, sh_ramp=0.0)
    batch = coordinator.next_batch()
    assert coordinator.run.reduction == 4
    (picture,), (sample,) = coordinator.render(batch).pictures, batch.samples
    raster = coordinator.run.rasterizer(whole_scene(coordinator), sample.view, sh_degree=1)
    merged = composite(raster.layer, sample.background).clamp(0, 1)
    assert float((picture - merged).detach().abs().max()) <= 1e-10


def test_what_density_control_judges_by_adds_up_over_cells(exact, photos):
    found = []
    for blocks in (1, 5):
        coordinator = exact(str(blocks), blocks=blocks, density=GROWING)
        batch = coordinator.next_batch()
        wanted = [photos(sample.view.index, sample.crop) for sample in batch.samples]
        coordinator.loss(batch, coordinator.render(batch).pictures, wanted).backward()
        gradients, order = coordinator.gradients(), coordinator._all.gaussians.quats[:, 0].argsort()
        found.append(gradients.sums[:, order])
    one, several = found
    assert float((one - several).abs().max()) <= 1e-5 * float(one.abs().max())
    assert float(one.abs().max()) > 0


def test_several_steps_are_those_of_a_plain_loop_over_everything(exact, photos):
    start = scene(torch.float32)
    blocks = exact(start=start, blocks=5, steps=12, fast_start=True)
    params = {name: torch.nn.Parameter(value.clone()) for name, value in start.items()}
    rates = {name: adam.param_groups[0]["lr"] for name, adam in blocks.optimizers.items()}
    adam = {n: torch.optim.Adam([p], lr=rates[n], eps=1e-15, fused=True) for n, p in params.items()}
    for step in range(12):
        batch = blocks.next_batch()
        (sample,) = batch.samples
        for name, rate in rates.items():
            decay = blocks.config.recipe.means_lr_decay ** (step / 12) if name == "means" else 1.0
            adam[name].param_groups[0]["lr"] = rate * decay * rates_of_under_trained(step, 1)
        raster = blocks.run.rasterizer(Gaussians(**params), sample.view, sh_degree=blocks.run.sh_degree)
        picture = composite(raster.layer, sample.background).clamp(0, 1)
        for optimizer in adam.values():
            optimizer.zero_grad()
        blocks.loss(batch, [picture], [photos(sample.view.index, sample.crop)]).backward()
        for optimizer in adam.values():
            optimizer.step()
        train_step(blocks, photos)
    found = by_rotation(whole_scene(blocks))
    expected = by_rotation(Gaussians(**{name: value.detach() for name, value in params.items()}))
    before = by_rotation(start)
    for name, value in expected.items():
        moved = float((value - getattr(before, name)).abs().max())
        # Adam divides by gradients' sizes: what rounding makes of the tiniest ones is a part of a step.
        assert float((getattr(found, name) - value).abs().mean()) < 1e-3 * moved, name


def test_the_device_holds_nothing_between_steps_and_the_store_all_at_the_end(exact, photos):
    coordinator = exact(blocks=4, steps=4)
    while not coordinator.finished:
        train_step(coordinator, photos)
        assert all(len(parameter) == 0 for parameter in coordinator.params.values())
    store, tree = coordinator.scene.store, coordinator.scene.tree
    assert sum(store.counts(block) for block in range(4)) == coordinator.count() == 150
    for block in range(4):
        assert bool((tree.assign(store.load(block)[0]["means"]) == block).all())


def test_a_scene_of_which_nothing_is_left_ends_in_one_line(exact, photos):
    with pytest.raises(UserError, match=r"no Gaussian is left: set .*cull-alpha-thresh lower"):
        train(exact(blocks=2, steps=40, density=replace(GROWING, cull_alpha_thresh=1.0)), photos)


def test_a_run_that_stops_goes_on(exact, photos):
    """On parts of pictures. The order in which gradients are added up changes with a resume."""
    options = {"steps": 10, "crop_pixels": 600}
    whole, stopped = exact("whole", **options), exact("stopped", **options)
    train(whole, photos)
    train(stopped, photos, steps=6)
    stop(stopped)
    again = exact("stopped", resume=True, **options)
    assert again.state.step == 6
    train(again, photos)
    found, expected = by_rotation(whole_scene(again)), by_rotation(whole_scene(whole))
    for name, value in expected.items():
        assert torch.allclose(getattr(found, name), value, rtol=1e-4, atol=1e-4), name


def test_views_of_a_step_may_differ_in_size(exact):
    """What density control counts is what it counts in one drawing of the whole batch."""
    views = [*ring_of_views(2), *ring_of_views(2, width=90)]
    views = [replace(view, index=index) for index, view in enumerate(views)]
    photos = Photos(random_gaussians(150, seed=7, size=0.12), views)
    counted = []
    for kind in (ExactTrainer, Coordinator):
        options = {"blocks": 1, "batch": 4, "steps": 4, "density": GROWING, "background": "black"}
        coordinator = exact(kind.__name__, views=views, kind=kind, **options)
        train_step(coordinator, photos)
        coordinator.save()
        counted.append(coordinator.scene.state(0 if kind is ExactTrainer else ACTIVE).growth)
    exactly, jointly = counted
    assert torch.allclose(exactly["worth"], jointly["worth"], rtol=1e-3, atol=1e-4)
    assert float(jointly["worth"][:, :24].abs().max()) > 0
