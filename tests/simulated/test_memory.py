"""The model of memory, by which blocks are made to fit, against what is live on the simulated device.

Each constant is compared with a slope: what one more pixel, or one more Gaussian, adds to the peak. It must
be no less than that, and no more than a few times as much, or devices would be left empty. What gsplat's
kernels take inside, and what an allocator cannot use, is not seen here.
"""

import gc
from dataclasses import replace

import pytest
import torch

from abcd_ns.engine.layers.layer_store import LayerStore
from abcd_ns.engine.render.cuda import fused
from abcd_ns.engine.render.cuda.backend import GsplatRasterizer
from abcd_ns.engine.train.density.control import DensityConfig
from abcd_ns.engine.train.memory import DeviceNeeds, frozen_bytes, levels_of, projected_bytes
from abcd_ns.engine.train.training_loop import train
from tests.reference.scenes import STILL, Photos, make_coordinator, random_gaussians, ring_of_views
from tests.reference.simulated_device import DEVICE

LAVISH, LAVISH_GAUSSIAN = 4.0, 1.5
GROWING = DensityConfig(refine_start=0.0, refine_stop=1.0, refine_every=2)


def run_on(folder, *, gaussians: int, width: int, size: float = 0.02, primitive: str = "3dgs", **options):
    """A coordinator for square pictures, after two steps, and its photos."""
    gc.collect()  # earlier ones hang in cycles, and would be counted until chance takes them
    views = ring_of_views(4, width=width, height=width)
    photos = Photos(random_gaussians(30, seed=7, size=0.12), views)
    start = random_gaussians(gaussians, seed=1, size=size, sh_degree=3)
    if "late_harmonics" in options:
        start = replace(start, features_rest=torch.zeros_like(start.features_rest))
    draws = GsplatRasterizer(primitive)
    options = {"steps": 40, "primitive": primitive, **options}
    coordinator = make_coordinator(folder, start, views, device=DEVICE, rasterizer=draws, **options)
    train(coordinator, photos, steps=2)
    return coordinator, photos


def peak_of_steps(counts, folder, **options) -> tuple[int, int]:
    """(live bytes at most, Gaussians after it) of two steps of a visit to a block that is the whole scene."""
    coordinator, photos = run_on(folder, blocks=1, **options)
    counts.reset_peak()
    train(coordinator, photos, steps=2)
    return counts.peak_bytes, coordinator.count()


@pytest.fixture(autouse=True)
def _uncompiled(simulated_gsplat, monkeypatch):  # noqa: ARG001 - which lends the kernels
    """What is modelled is what most is taken by: steps without Triton's kernels."""
    for name in ("between", "photometric", "shade", "skips", "windowed"):
        monkeypatch.setattr(fused, name, fused.Fused(name, None))


@pytest.mark.parametrize(("batch", "given"), [(2, {}), (1, {"light": "affine"})])
def test_what_a_pixel_takes_in_a_step(tmp_path, simulated_gsplat, batch, given):
    options = {"gaussians": 40, "batch": batch, "density": STILL, **given}
    (small, _), (large, _) = (
        peak_of_steps(simulated_gsplat, tmp_path / str(w), width=w, **options) for w in (48, 96)
    )
    model = [DeviceNeeds(w**2, batch, levels=0).step_bytes for w in (48, 96)]
    assert large - small <= model[1] - model[0] <= LAVISH * (large - small)


@pytest.mark.parametrize(
    ("batch", "given"),
    [(4, {}), (4, {"batch_limit": 1}), (1, {"primitive": "2dgs"}), (1, {"late_harmonics": 3})],
)
def test_what_a_gaussian_takes(tmp_path, simulated_gsplat, batch, given):
    options = {"width": 32, "batch": batch, "density": GROWING, **given}
    (small, few), (large, many) = (
        peak_of_steps(simulated_gsplat, tmp_path / str(n), gaussians=n, **options) for n in (300, 1200)
    )
    primitive = given.get("primitive", "3dgs")
    degree = 3 - given.get("late_harmonics", 0)
    at_once = given.get("batch_limit", batch)
    options = {"primitive": primitive, "active_degree": degree, "in_parts": at_once < batch}
    needs = DeviceNeeds(32**2, at_once, levels=0, **options)
    model = needs.gaussian_bytes * (many - few)
    assert large - small <= model <= LAVISH_GAUSSIAN * (large - small)


def peak_of_layers(counts, coordinator) -> int:
    """Live bytes at most while the layers of a visit's first view are drawn, beside what was there."""
    layers, view = coordinator.visit.layers, coordinator.state.active.geometry.views[0]
    layers._store = LayerStore(DEVICE, 1 << 30)
    held = counts.live_bytes
    counts.reset_peak()
    list(layers.draw([view]))
    return counts.peak_bytes - held


def test_what_a_pixel_takes_while_layers_are_drawn(tmp_path, simulated_gsplat):
    peaks, blocks = [], 8
    for width in (48, 96):
        options = {"gaussians": 60, "width": width, "size": 0.2, "blocks": blocks, "pass_gaussians": 1}
        coordinator, _ = run_on(tmp_path / str(width), **options)
        geometry = coordinator.state.active.geometry
        pixels = geometry.crops[geometry.views[0]].pixels
        peaks.append((pixels, peak_of_layers(simulated_gsplat, coordinator)))
    (few, small), (many, large) = peaks
    huge = 1 << 26  # so that no least amount counts
    one, two = (DeviceNeeds(n * huge, 1, levels=levels_of(blocks)).drawing_bytes for n in (1, 2))
    per_pixel = (two - one) / huge
    slope = (large - small) / (many - few)
    assert slope <= per_pixel <= LAVISH * slope


def test_what_a_frozen_gaussian_takes_while_layers_are_drawn(tmp_path, simulated_gsplat):
    peaks = []
    for gaussians in (800, 1600):
        options = {"gaussians": gaussians, "width": 32, "blocks": 4, "density": STILL}
        coordinator, _ = run_on(tmp_path / str(gaussians), **options)
        frozen = coordinator.count() - len(coordinator.params["means"])
        peaks.append((frozen, peak_of_layers(simulated_gsplat, coordinator)))
    (few, small), (many, large) = peaks
    slope = (large - small) / (many - few)
    assert slope <= frozen_bytes(3, "3dgs") <= LAVISH_GAUSSIAN * slope


@pytest.mark.parametrize("primitive", ["3dgs", "2dgs"])
def test_what_a_gaussian_is_in_a_view(tmp_path, simulated_gsplat, primitive):
    """What each further view of a step adds: a surfel has more rows than an ellipsoid."""

    def peak(batch: int, gaussians: int) -> int:
        folder = tmp_path / f"{batch}-{gaussians}"
        options = {"gaussians": gaussians, "batch": batch, "primitive": primitive}
        return peak_of_steps(simulated_gsplat, folder, width=32, density=STILL, **options)[0]

    few, many = 600, 1400  # so many that pictures are a small part
    slope = (peak(3, many) - peak(3, few) - peak(1, many) + peak(1, few)) / 2 / (many - few)
    assert slope <= projected_bytes(primitive) <= LAVISH * slope
