"""The z window of a visit holds what shows, and what is cut by it adds up to the merged picture."""

import math

import pytest
import torch
from hypothesis import given, settings

from abcd_ns.engine.render import CutShot, Shot, TorchRasterizer, ZWindow
from abcd_ns.engine.types import Crop, Gaussians, View
from tests.engine.space.test_tree import SEEDS
from tests.reference.rasterizer_scenes import assert_same_layer
from tests.reference.scenes import random_gaussians, ring_of_views

DRAW = TorchRasterizer(use_native=False)
SIDE = DRAW.tile_side
STOP = 2e-4
"""Drawing stops at T <= 1e-4, so that weights may differ from those by hand by about that much."""


def scene(seed: int, n: int = 40, size: float = 0.1) -> tuple[Gaussians, View]:
    (view,) = ring_of_views(1, width=32, height=24, dtype=torch.float64)
    return random_gaussians(n, seed=seed, size=size, dtype=torch.float64), view


def weights_by_hand(gaussians: Gaussians, view: View) -> tuple[torch.Tensor, torch.Tensor]:
    """(alpha T [n, h, w], camera z [n]), nearest first: one Gaussian drawn after the other."""
    splats = DRAW.project(gaussians, view)
    order = splats.depths.argsort(stable=True)
    alone = [Shot(view, view.full, splats[index[None]]) for index in order]
    light = torch.ones(view.height, view.width, dtype=torch.float64)
    weights = []
    for raster in DRAW.draw(gaussians[:0], alone, sh_degree=0):
        weights.append((1 - raster.transmittance) * light)
        light = light * raster.transmittance
    return torch.stack(weights), splats.depths[order]


@settings(max_examples=6)
@given(SEEDS)
def test_what_the_window_leaves_out_on_either_side_weighs_less_than_said(seed):
    gaussians, view = scene(seed)
    weights, z = weights_by_hand(gaussians, view)
    weights, z = torch.nn.functional.avg_pool2d(weights, SIDE), z[:, None, None]
    infinity = torch.tensor(math.inf, dtype=torch.float64)
    for visible in (0.002, 0.02, 0.1):
        window = next(DRAW.depth_windows(gaussians, [Shot(view, view.full)], visible=visible))
        near = window.near.view(weights.shape[1:])
        far = window.far.view(weights.shape[1:])
        assert float((weights * (z < near)).sum(dim=0).max()) < visible + STOP
        assert float((weights * (z >= far)).sum(dim=0).max()) < visible + STOP
        # And it is no wider than that takes, where there is more to be seen than may be left out.
        head, tail = weights.cumsum(0), weights.flip(0).cumsum(0).flip(0)
        least = torch.where(head >= visible - STOP, z, infinity).amin(dim=0)
        most = torch.where(tail >= visible - STOP, z, -infinity).amax(dim=0)
        shows = weights.sum(dim=0) > 2 * (visible + STOP)
        assert bool((near >= least)[shows].all())
        assert bool((far <= most.nextafter(infinity))[shows].all())


def test_where_nothing_shows_the_window_is_empty_and_in_the_midst():
    gaussians, view = scene(0, n=3, size=0.02)
    window = next(DRAW.depth_windows(gaussians, [Shot(view, view.full)], visible=0.01))
    z = DRAW.project(gaussians, view).depths
    empty = window.near >= window.far
    assert 0.5 < float(empty.double().mean()) < 1
    assert bool((window.near[empty] == window.far[empty]).all())
    midst = window.near[empty]
    assert float(z.min()) - 1e-9 < float(midst.min()) <= float(midst.max()) < float(z.max()) + 1e-9
    nobody = next(DRAW.depth_windows(gaussians[:0], [Shot(view, Crop(3, 5, 20, 9))], visible=0.0))
    assert nobody.near.shape == (nobody.grid.tiles,)
    assert bool((nobody.near == nobody.far).all())


def test_tiles_that_stick_out_of_the_crop_count_their_own_pixels():
    gaussians, view = scene(5)
    visible, crop = 0.2, Crop(0, 0, 32, 21)  # the last row of tiles has a single row of pixels
    window = next(DRAW.depth_windows(gaussians, [Shot(view, crop)], visible=visible))
    shows = (window.near < window.far).view(6, 8)[-1]
    weights, _ = weights_by_hand(gaussians, view)
    total = weights.sum(dim=0)[20].view(8, SIDE).mean(dim=1)
    assert bool(((total > visible) & (total < visible * SIDE)).any())  # where counting 16 pixels would show
    clear = (total - visible).abs() > STOP
    assert torch.equal(shows[clear], total[clear] >= visible)


@pytest.mark.parametrize(("use_native", "at_once"), [(True, (600, 10**6)), (False, (10**6, 130))])
def test_views_that_are_drawn_together_have_the_pictures_of_each_alone(monkeypatch, use_native, at_once):
    monkeypatch.setattr("abcd_ns.engine.render.cpu.backend.PIXELS_AT_ONCE", at_once[0])
    monkeypatch.setattr("abcd_ns.engine.render.cpu.backend.SPLATS_AT_ONCE", at_once[1])
    draw = TorchRasterizer(use_native=use_native)
    views = ring_of_views(5, width=32, height=24)
    seen = [Shot(view, Crop(k, 2 * k, 12 + 4 * k, 9 + 2 * k)) for k, view in enumerate(views)]
    active, frozen = random_gaussians(30, seed=1), random_gaussians(60, seed=2)
    windows = list(draw.depth_windows(active, seen, visible=0.02))
    assert [window.grid for window in windows] == [draw.window_grid(shot.crop) for shot in seen]
    shots = []
    for shot, window in zip(seen, windows, strict=True):
        alone = next(draw.depth_windows(active, [shot], visible=0.02))
        assert torch.equal(window.near, alone.near)
        assert torch.equal(window.far, alone.far)
        span = ZWindow.everything(window.grid, "cpu", torch.float32)
        shots.append(CutShot(shot.view, shot.crop, *span.cut_by(window)))
    for cut, shot in zip(draw.cuts(frozen, shots, sh_degree=1), shots, strict=True):
        (alone,) = draw.cuts(frozen, [shot], sh_degree=1)
        assert torch.equal(cut.kept_ids, alone.kept_ids)
        assert torch.equal(cut.inside.planes, alone.inside.planes)
        for found, expected in ((cut.front, alone.front), (cut.back, alone.back)):
            assert_same_layer(found, expected)
            assert float((1 - found.transmittance).max()) > 0
