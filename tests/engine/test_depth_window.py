"""The z window of a visit holds what shows, and what is cut by it adds up to the merged picture."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from abcd_ns.engine.compositing import sandwich
from abcd_ns.engine.rasterizer import Shot, TorchRasterizer, ZWindow
from abcd_ns.engine.types import Crop, Gaussians, View
from tests.reference.scenes import random_gaussians, ring_of_views

DRAW = TorchRasterizer(compile="never")
SIDE = DRAW.tile_side


def scene(seed: int, n: int = 40, size: float = 0.1) -> tuple[Gaussians, View]:
    (view,) = ring_of_views(1, width=32, height=24, dtype=torch.float64)
    return random_gaussians(n, seed=seed, size=size, dtype=torch.float64), view


def weights_by_hand(gaussians: Gaussians, view: View) -> tuple[torch.Tensor, torch.Tensor]:
    """(alpha T [n, h, w], camera z [n]) by drawing, front to back, one Gaussian after the other."""
    splats = DRAW.project(gaussians, view)
    light = torch.ones(view.height, view.width, dtype=torch.float64)
    weights = torch.zeros(len(gaussians), view.height, view.width, dtype=torch.float64)
    for index in splats.depths.argsort(stable=True).tolist():
        alpha = 1 - DRAW(gaussians[torch.tensor([index])], view, sh_degree=0).transmittance
        weights[index] = alpha * light
        light = light * (1 - alpha)
    return weights, splats.depths


def tiled(image: torch.Tensor) -> torch.Tensor:
    """[..., tile row, tile column, pixel] of whole tiles."""
    rows, cols = image.shape[-2] // SIDE, image.shape[-1] // SIDE
    blocks = image.reshape(*image.shape[:-2], rows, SIDE, cols, SIDE)
    return blocks.transpose(-3, -2).flatten(-2)


@pytest.mark.parametrize("visible", [0.002, 0.02, 0.1])
@given(seed=st.integers(0, 10**6))
def test_the_window_is_the_range_of_what_shows(visible, seed):
    gaussians, view = scene(seed)
    window = DRAW.depth_window(gaussians, view, crop=view.full, visible=visible)
    weights, z = weights_by_hand(gaussians, view)
    by_tile = tiled(weights).mean(dim=-1)
    # Drawing stops at T <= 1e-4, so that weights differ from these by that much.
    surely, perhaps = by_tile >= visible + 2e-4, by_tile >= visible - 2e-4
    near, far = tiled(window.near), tiled(window.far)
    assert bool((near == near[..., :1]).all() and (far == far[..., :1]).all())
    near, far, z = near[..., 0], far[..., 0], z[:, None, None]
    assert not bool((surely & ~((near <= z) & (z < far))).any())
    infinity = torch.tensor(math.inf, dtype=torch.float64)
    widest_near = torch.where(perhaps, z, infinity).amin(dim=0)
    widest_far = torch.where(perhaps, z, -infinity).amax(dim=0)
    shows = near < far
    assert bool((near >= widest_near)[shows].all() and (far <= widest_far.nextafter(infinity))[shows].all())


@given(seed=st.integers(0, 10**6))
def test_at_0_every_fragment_is_in_the_window(seed):
    gaussians, view = scene(seed, size=0.2)
    window = DRAW.depth_window(gaussians, view, crop=view.full, visible=0.0)
    through = DRAW(gaussians, view, sh_degree=0, z_window=window)
    whole = DRAW(gaussians, view, sh_degree=0)
    assert torch.equal(through.color, whole.color)
    assert torch.equal(through.transmittance, whole.transmittance)


def test_where_nothing_shows_the_window_is_empty_and_in_the_midst():
    gaussians, view = scene(0, n=3, size=0.02)
    window = DRAW.depth_window(gaussians, view, crop=view.full, visible=0.01)
    z = DRAW.project(gaussians, view).depths
    empty = window.near >= window.far
    assert 0.5 < float(empty.double().mean()) < 1
    assert bool((window.near[empty] == window.far[empty]).all())
    assert (
        float(z.min()) <= float(window.near[empty].min()) <= float(window.near[empty].max()) <= float(z.max())
    )


def test_a_window_of_no_gaussians_is_empty():
    _, view = scene(0)
    window = DRAW.depth_window(Gaussians.empty(0), view, crop=Crop(3, 5, 20, 9), visible=0.01)
    assert window.near.shape == (9, 20)
    assert bool((window.near == window.far).all())


@pytest.mark.parametrize("crop", [None, Crop(5, 3, 18, 14)])
@given(seed=st.integers(0, 10**6))
def test_front_inside_and_back_are_the_merged_picture(seed, crop):
    """With any active Gaussians in the window's midst."""
    everyone, view = scene(seed, n=60)
    everyone.opacities[:] -= 2.5  # so thin that no drawing stops early
    crop = crop or view.full
    active, frozen = everyone[torch.arange(20)], everyone[torch.arange(20, 60)]
    window = DRAW.depth_window(active, view, crop=crop, visible=0.0)
    before = ZWindow(torch.full_like(window.near, -math.inf), window.near)
    behind = ZWindow(window.far, torch.full_like(window.far, math.inf))
    cut = DRAW.cut(frozen, view, front=before, inside=window, back=behind, crop=crop, sh_degree=0)
    assert torch.equal(cut.members, cut.members.unique())
    assert torch.equal(cut.inside.planes, DRAW.project(frozen, view)[cut.members].planes)
    (middle,) = DRAW.draw(active, [Shot(view, crop, cut.inside, window)], sh_degree=0)
    found = sandwich(cut.front, middle.layer, cut.back, torch.zeros(3, dtype=torch.float64))
    whole = DRAW(everyone, view, sh_degree=0, crop=crop)
    assert float((found - whole.color).abs().max()) < 1e-12
