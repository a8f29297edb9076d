"""The coordinator on a CUDA device: it trains, goes on where it stopped, and gives back what it took.

Nothing is compared bit for bit: gsplat's backward pass adds up in no fixed order.
"""

import math
from functools import partial

import pytest
import torch

from abcd_ns.engine.events import Repaired, StepTaken, VisitEnded
from abcd_ns.engine.render import loss
from abcd_ns.engine.render.cuda import pairs as gsplat_pairs
from abcd_ns.engine.store.special_blocks import ACTIVE
from abcd_ns.engine.train.density.control import DensityConfig
from abcd_ns.engine.train.training_loop import train, train_step
from tests.reference.scenes import (
    GROWING,
    STILL,
    Photos,
    listen,
    random_gaussians,
    ring_of_views,
    spoil_gradients,
    stop,
    whole_scene,
)

pytestmark = pytest.mark.gpu
STEPS = 20


@pytest.fixture(scope="module")
def views():
    return ring_of_views(5, width=96, height=72)


@pytest.fixture
def begin(make, rasterizer, device):
    """Makes runs on the device."""
    start = random_gaussians(300, seed=1, size=0.12)
    options = {"steps": STEPS, "background": "black", "rasterizer": rasterizer, "device": device}
    return partial(make, start=start, **options)


def pictures(coordinator, views) -> torch.Tensor:
    """All views of the whole scene, drawn on the CPU."""
    drawn = Photos(whole_scene(coordinator), views).images
    return torch.stack([drawn[view.index] for view in views])


def mean_error(coordinator, views, photos) -> float:
    wanted = torch.stack([photos.images[view.index] for view in views])
    return float((pictures(coordinator, views) - wanted).square().mean())


@pytest.mark.parametrize("blocks", [1, 4])
def test_steps_on_the_device_make_the_photos_more_alike(begin, views, photos, blocks):
    coordinator = begin(blocks=blocks, density=GROWING, ownership="fragments")
    seen = listen(coordinator, StepTaken)
    before = mean_error(coordinator, views, photos)
    train(coordinator, photos)
    assert len(seen) == STEPS
    assert all(math.isfinite(event.psnr) for event in seen if event.visit_step > 1)  # told a step late
    assert all(bool(value.isfinite().all()) for _, value in whole_scene(coordinator).items())
    assert mean_error(coordinator, views, photos) < 0.9 * before


@pytest.mark.parametrize("light", ["exposure", "affine"])
def test_light_is_found_on_the_device(begin, photos, light):
    coordinator = begin(blocks=1, light=light, density=STILL)
    train(coordinator, photos)
    found = torch.stack([coordinator.run.light.of(view).detach().cpu() for view in coordinator.run.views])
    assert bool(found.isfinite().all())
    assert bool((found != found[0]).any())


def test_a_step_whose_gradients_are_no_numbers_is_skipped(begin, photos, device):
    """CUDA's fused Adam is told by a tensor that it is to do nothing."""
    if device.type != "cuda":
        pytest.skip("on the CPU rows are cleaned at once")
    coordinator = begin(blocks=1, density=STILL)
    told = listen(coordinator, Repaired)
    train(coordinator, photos, steps=2)
    before = coordinator.params["means"].detach().clone()
    spoil_gradients(coordinator, "means", 2, math.nan, at=2)
    train(coordinator, photos, steps=1)
    assert torch.equal(before, coordinator.params["means"])
    train(coordinator, photos, steps=1)
    assert not torch.equal(before, coordinator.params["means"])
    assert [(event.what, event.count) for event in told] == [("gradients", 1)]


@pytest.mark.filterwarnings("ignore:Synchronization debug mode")
def test_a_step_makes_the_host_wait_for_lists_and_numbers_alone(begin, photos, device, monkeypatch):
    """As tests/simulated counts it. Every other operation that synchronises raises."""
    if device.type != "cuda":
        pytest.skip("only CUDA tells what synchronises")
    coordinator = begin(blocks=4, density=DensityConfig(refine_start=1.0), steps=200)
    train(coordinator, photos, steps=2)

    def allowed(*args, **options):
        torch.cuda.set_sync_debug_mode("default")
        found = isect_tiles(*args, **options)
        torch.cuda.set_sync_debug_mode("error")
        return found

    isect_tiles = gsplat_pairs.isect_tiles
    monkeypatch.setattr(gsplat_pairs, "isect_tiles", allowed)
    steps_left = coordinator.state.active.steps - coordinator.state.active.done
    assert steps_left > 1
    for _ in range(steps_left - 1):
        torch.cuda.set_sync_debug_mode("error")
        try:
            train_step(coordinator, photos)
        finally:
            torch.cuda.set_sync_debug_mode("default")


@pytest.mark.parametrize("blocks", [1, 4])
def test_a_run_that_goes_on_comes_to_the_same_picture(begin, views, photos, blocks):
    options = {"blocks": blocks, "density": STILL}
    whole = begin("whole", **options)
    train(whole, photos)
    stopped = begin("stopped", **options)
    train(stopped, photos, steps=STEPS // 2 + 1)
    stop(stopped)
    went_on = begin("stopped", resume=True, **options)
    assert went_on.state.step == STEPS // 2 + 1
    train(went_on, photos)
    off = (pictures(whole, views) - pictures(went_on, views)).abs().mean(dim=(1, 2, 3))
    assert float(off.max()) < 3e-3


def test_memory_is_after_a_visit_what_it_was_before(begin, photos, device):
    """Else a scene could not be larger than the device. Blocks are alike in size."""
    if device.type != "cuda":
        pytest.skip("only CUDA says how much memory is held")
    coordinator = begin(blocks=4, steps=200, density=STILL)
    ended, held = listen(coordinator, VisitEnded), []
    while len(held) < 6:
        train_step(coordinator, photos)
        if len(ended) > len(held):
            for optimizer in coordinator.optimizers.values():
                optimizer.zero_grad(set_to_none=True)
            torch.cuda.synchronize()
            held.append(torch.cuda.memory_allocated())
    # The first visit leaves what is kept for good: cameras, caches.
    assert max(held[1:]) <= held[1] + 2**18, held


@pytest.mark.parametrize("size", [(53, 80), (106, 160), (40, 33), (11, 11)])
def test_the_loss_is_the_cpus(device, size):
    loss.warm_up(device)
    pictures, found = torch.rand(2, *size, 3, generator=torch.Generator().manual_seed(0)), []
    for place in (device, "cpu"):
        picture, photo = pictures.to(place)
        picture.requires_grad_()
        counts = {"full_pixels": math.prod(size), "full_windows": loss.ssim_windows(*size)}
        value = loss.photometric_loss(picture, photo, **counts)
        value.backward()
        found.append((value.detach().cpu(), picture.grad.cpu()))
    torch.testing.assert_close(found[0], found[1], rtol=1e-3, atol=1e-7)


def test_what_is_saved_in_the_midst_of_a_visit_is_not_pinned(begin, photos):
    coordinator = begin(blocks=1)
    train(coordinator, photos, steps=3)
    coordinator.persist(600.0)
    tensors = coordinator.scene._unsaved[ACTIVE].tensors.values()
    assert not any(tensor.is_pinned() for tensor in tensors)
    coordinator.close()
