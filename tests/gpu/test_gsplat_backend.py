"""gsplat's CUDA kernels against the torch backend: pictures, gradients, crops, frozen Gaussians, z windows.

Cameras are on the CPU, as everywhere in the engine.
"""

from dataclasses import replace

import pytest
import torch

from abcd_ns.engine.layers.compositing import sandwich
from abcd_ns.engine.render import CutShot, Shot, TorchRasterizer, ZWindow
from abcd_ns.engine.types import PARAM_NAMES, Crop, Gaussians, View
from tests.reference.rasterizer_scenes import (
    as_leaves,
    probe,
    random_gaussians,
    relative_error,
    small_view,
    stacked,
)

pytestmark = pytest.mark.gpu
WIDTH, HEIGHT = 150, 100
CROPS = [None, Crop(16, 32, 64, 48), Crop(37, 5, 70, 61)]


@pytest.fixture
def scene(device):
    """Makes a scene of n Gaussians on the device."""
    return lambda n, seed=0: random_gaussians(n, seed, dtype=torch.float32).to(device)


def view() -> View:
    return small_view(WIDTH, HEIGHT, dtype=torch.float32)


@pytest.mark.parametrize(
    ("primitive", "antialiased", "windowed"),
    [("3dgs", False, False), ("3dgs", True, True), ("2dgs", False, True)],
)
def test_shots_that_are_drawn_together_are_the_torch_backends(
    rasterizers, scene, primitive, antialiased, windowed, device
):
    """Of different sizes, with crops anywhere: the list's end, which no tile is to draw, included. The last
    is a whole view without frozen splats."""
    views = [view(), view(), view(), replace(view(), width=120), view()]
    for k, each in enumerate(views):
        each.viewmat[0, 3] += 0.1 * k
    crops = [CROPS[1], CROPS[2], Crop(133, 80, 17, 20), Crop(0, 0, 40, 100), view().full]
    rasterizer, options, found = rasterizers[primitive], {"sh_degree": 3, "antialiased": antialiased}, []
    for backend in (rasterizer, TorchRasterizer(use_native=False, tile_side=16, primitive=primitive)):
        leaves, shots = as_leaves(scene(300)), []
        for k, (each, crop) in enumerate(zip(views, crops, strict=True)):
            grid = rasterizer.window_grid(crop)
            near = 3.0 + torch.sin(torch.arange(grid.tiles, device=device, dtype=torch.float32))
            window = ZWindow(grid, near, near + 1.5) if windowed else None
            frozen = None if k == 4 else backend.project(scene(60, seed=k + 1), each, **options)
            shots.append(Shot(each, crop, frozen, window))
        rasters = backend.draw(leaves, shots, **options)
        weights = [probe(*r.depth.shape, dtype=torch.float32).to(device) for r in rasters]
        sum((stacked(r) * w).sum() for r, w in zip(rasters, weights, strict=True)).backward()
        picture = torch.cat([stacked(raster).detach().flatten() for raster in rasters])
        found.append((picture, {name: getattr(leaves, name).grad for name in PARAM_NAMES}))
    # A fragment at the 1/255 threshold may fall on either side: rounding differs, so a few pixels may too.
    difference = (found[0][0] - found[1][0]).abs() / found[1][0].abs().amax()
    assert difference.mean() < 1e-5
    for name in PARAM_NAMES:
        assert relative_error(found[0][1][name], found[1][1][name]) < 1e-2, name


def test_extents_are_the_torch_backends(rasterizer, scene):
    gaussians = scene(200)
    views = [view(), replace(view(), width=120), replace(view(), near=5.0)]
    found, expected = (
        draw.extents(gaussians, views) for draw in (rasterizer, TorchRasterizer(use_native=False))
    )
    assert found.device.type == "cpu"
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1.1)  # a radius may be rounded up elsewhere


def test_graph_is_freed_without_a_backward_pass(rasterizer, scene, device):
    if device.type != "cuda":
        pytest.skip("only CUDA says how much memory is held")

    seen = view()  # cameras are kept on the device

    def draw():
        return rasterizer(as_leaves(scene(2000)), seen, sh_degree=3, crop=CROPS[1])

    draw()
    torch.cuda.synchronize()
    before = torch.cuda.memory_allocated()
    for _ in range(5):
        draw()
    assert torch.cuda.memory_allocated() <= before


def test_nothing_to_draw(rasterizer, scene, device):
    behind = scene(5)
    behind.means[:] -= 100
    for nothing in (Gaussians.empty(device=device), behind):
        raster = rasterizer(as_leaves(nothing), view(), sh_degree=3, crop=CROPS[1])
        stacked(raster).sum().backward()
        assert (raster.transmittance == 1).all()


@pytest.mark.parametrize("crop", CROPS)
def test_a_depth_window_is_the_torch_backends(rasterizer, scene, crop):
    gaussians, seen = scene(100), [Shot(view(), crop or view().full)]
    backends = rasterizer, TorchRasterizer(use_native=False, tile_side=16)
    found, expected = (next(backend.depth_windows(gaussians, seen, visible=0.02)) for backend in backends)
    assert found.grid == expected.grid
    for side in ("near", "far"):
        alike = torch.isclose(getattr(found, side), getattr(expected, side), rtol=1e-3)
        # A weight at the threshold may fall on either side of it.
        assert alike.float().mean() > 0.95, side


@pytest.mark.parametrize("crop", CROPS)
def test_front_inside_and_back_are_the_torch_backends_and_the_merged_picture(rasterizer, scene, crop, device):
    everyone, crop = scene(300), crop or view().full
    everyone.opacities[:] -= 4.0  # so faint that drawing stops nowhere: parts then add up to the whole
    active, frozen = everyone[:100], everyone[100:]
    window = next(rasterizer.depth_windows(active, [Shot(view(), crop)], visible=0.0))
    every = ZWindow.everything(window.grid, device, torch.float32)
    shot = CutShot(view(), crop, *every.cut_by(window))
    cuts = []
    for backend in (rasterizer, TorchRasterizer(use_native=False, tile_side=16)):
        (cut,) = backend.cuts(frozen, [shot], sh_degree=3)
        (middle,) = backend.draw(active, [Shot(view(), crop, cut.inside, window)], sh_degree=3)
        found = sandwich(cut.front, middle.layer, cut.back, torch.zeros(3, device=device))
        whole = backend(everyone, view(), sh_degree=3, crop=crop)
        torch.testing.assert_close(found, whole.color, rtol=1e-4, atol=1e-4)
        cuts.append(cut)
    for name in ("front", "back"):
        found, expected = (getattr(cut, name).transmittance for cut in cuts)
        assert (found - expected).abs().mean() < 1e-4, name
        assert bool((expected < 0.99).any()), name
    # gsplat lists a Gaussian in every tile of its box. One whose only fragment is faint may be in either.
    found, expected = (set(cut.kept_ids.tolist()) for cut in cuts)
    assert len(expected - found) <= 0.02 * len(frozen)
