"""The model of memory, by which blocks are made to fit, against what is live on the simulated device.

Each constant is compared with a slope: what one more pixel, or one more Gaussian, adds to the peak. It must be no
less than that, and no more than LAVISH times as much, or devices would be left half empty. What gsplat's kernels
take inside is not seen here.
"""

import pytest
import torch

from abcd_ns.engine.density import DensityConfig
from abcd_ns.engine.memory import DeviceNeeds, levels_of
from abcd_ns.engine.training_loop import train
from tests.reference.scenes import Photos, random_gaussians, ring_of_views
from tests.simulated.test_coordinators import on_device

LAVISH = 4.0


def peak(counts, folder, *, gaussians: int, width: int, batch: int = 1, blocks: int = 1, grows: bool = False):
    """Live bytes at most in a step in the midst of a visit, or, where it grows, in a whole visit."""
    views = ring_of_views(4, width=width, height=width)
    photos = Photos(random_gaussians(30, seed=7, size=0.12), views)
    start = random_gaussians(gaussians, seed=1, size=0.02, sh_degree=3)
    growing = DensityConfig(refine_start=0.0, refine_stop=1.0, warmup_passes=0, refine_every=2)
    density = growing if grows else DensityConfig(strategy="off")
    options = {"blocks": blocks, "steps": 12, "batch": batch, "density": density, "sh_degree": 3}
    coordinator = on_device(folder, start, views, processes=1, **options)
    if not grows:
        train(coordinator, photos, steps=2)
    counts.reset_peak()
    train(coordinator, photos, steps=2)
    return counts.peak_bytes


@pytest.mark.parametrize("batch", [1, 2])
def test_what_a_pixel_takes_in_a_step(tmp_path, simulated_gsplat, batch):
    sizes = (64, 128)
    peaks = [
        peak(simulated_gsplat, tmp_path / str(size), gaussians=40, width=size, batch=batch) for size in sizes
    ]
    more = sizes[1] ** 2 - sizes[0] ** 2
    model = [DeviceNeeds(size**2, batch, levels=0).step_bytes for size in sizes]
    assert peaks[1] - peaks[0] <= model[1] - model[0] <= LAVISH * (peaks[1] - peaks[0])
    assert more > 0


@pytest.mark.parametrize("grows", [False, True])
def test_what_a_gaussian_takes(tmp_path, simulated_gsplat, grows):
    numbers = (500, 3000)
    peaks = [peak(simulated_gsplat, tmp_path / str(n), gaussians=n, width=32, grows=grows) for n in numbers]
    model = DeviceNeeds(32**2, 1, levels=0).gaussian_bytes * (numbers[1] - numbers[0])
    assert peaks[1] - peaks[0] <= model <= LAVISH * (peaks[1] - peaks[0])


@pytest.mark.parametrize("blocks", [2, 8])
def test_what_a_pixel_takes_while_layers_are_drawn(tmp_path, simulated_gsplat, blocks):
    """From the beginning of the second visit to its first step; the pictures are the larger part."""
    found = []
    for width in (64, 128):
        views = ring_of_views(3, width=width, height=width)
        photos = Photos(random_gaussians(30, seed=7, size=0.12), views)
        start = random_gaussians(60, seed=1, size=0.05)
        coordinator = on_device(
            tmp_path / str(width), start, views, blocks=blocks, steps=9, batch=1, processes=1
        )
        train(coordinator, photos, steps=1)
        simulated_gsplat.reset_peak()
        wanted = coordinator.state.active.geometry.views[:1]
        coordinator._layers._at_hand.clear()
        with torch.no_grad():
            list(coordinator._layers.draw(wanted))
        crop = coordinator.state.active.geometry.crops[wanted[0]]
        found.append((crop.pixels, simulated_gsplat.peak_bytes))
    (few, small), (many, large) = found
    levels = levels_of(blocks)
    per_pixel = DeviceNeeds(1 << 24, 1, levels=levels).drawing_bytes - DeviceNeeds(0, 1).drawing_bytes
    slope = (large - small) / (many - few)
    assert slope <= per_pixel / (1 << 24) * 1.2
