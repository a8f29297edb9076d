"""TorchRasterizer against the naive twin: forward, gradient, crops, windows, frozen Gaussians."""

import itertools
from dataclasses import replace
from functools import partial

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from abcd_ns.engine.gaussians.spherical_harmonics import SH_C0
from abcd_ns.engine.render import Shot, TorchRasterizer, ZWindow, make_rasterizer
from abcd_ns.engine.render.z_window import TileGrid
from abcd_ns.engine.types import PARAM_NAMES, Crop
from tests.reference.naive_rasterizer import naive_rasterize
from tests.reference.rasterizer_scenes import (
    as_leaves,
    assert_drawn_alike,
    drawn,
    gradients,
    probe,
    random_gaussians,
    random_window,
    relative_error,
    small_view,
    stacked,
)

VIEW = small_view()
CROP = Crop(5, 3, 22, 15)
EAGER = TorchRasterizer(use_native=False)
SURFELS = TorchRasterizer(use_native=False, primitive="2dgs")
BOTH = pytest.mark.parametrize("draw", [EAGER, SURFELS], ids=["3dgs", "2dgs"])


def by_pixel(window: ZWindow) -> torch.Tensor:
    """(near, far) of each pixel, [2, h, w]."""
    planes = torch.stack((window.near, window.far))[..., None]
    return window.grid.to_image(planes.expand(-1, -1, window.grid.side**2))


@pytest.mark.parametrize(
    ("sh_degree", "antialiased", "crop", "with_frozen", "windowed"),
    [
        (1, True, None, False, False),
        (0, False, None, True, False),
        (2, True, CROP, False, True),
        (3, False, CROP, True, True),
    ],
)
@BOTH
def test_equals_the_naive_twin(draw, sh_degree, antialiased, crop, with_frozen, windowed):
    gaussians, frozen = random_gaussians(12), random_gaussians(8, seed=7) if with_frozen else None
    window = random_window(draw.window_grid(crop or VIEW.full)) if windowed else None
    near, far = by_pixel(window) if window else (None, None)
    options = {"sh_degree": sh_degree, "crop": crop, "frozen": frozen, "antialiased": antialiased}

    def naive(g):
        return naive_rasterize(g, VIEW, near=near, far=far, primitive=draw.primitive.name, **options)

    found = partial(drawn, draw, view=VIEW, z_window=window, **options)
    assert_drawn_alike(found, naive, gaussians, 1e-11, 1e-10)


def test_rays_that_stop_early_and_alphas_at_the_clamp_equal_the_naive_twins():
    many = random_gaussians(25)
    opaque = replace(many, opacities=many.opacities + 9, scales=many.scales + 0.5)
    dense = naive_rasterize(opaque, VIEW, sh_degree=0)
    assert dense.transmittance.min() < 2e-3
    torch.testing.assert_close(
        stacked(EAGER(opaque, VIEW, sh_degree=0)), stacked(dense), rtol=1e-11, atol=1e-12
    )


@pytest.mark.parametrize("draw", [EAGER, TorchRasterizer()], ids=["torch", "native"])
@given(data=st.data())
@settings(max_examples=12)
def test_crop_is_bit_equal_to_the_crop_of_the_full_image(draw, data):
    view = small_view(53, 41, dtype=torch.float32)
    gaussians = random_gaussians(150, seed=1, sh_degree=1, dtype=torch.float32)
    x, y = data.draw(st.integers(0, 52)), data.draw(st.integers(0, 40))
    crop = Crop(x, y, data.draw(st.integers(1, 53 - x)), data.draw(st.integers(1, 41 - y)))
    full = draw(gaussians, view, sh_degree=1)
    part = draw(gaussians, view, sh_degree=1, crop=crop)
    assert torch.equal(stacked(part), stacked(full)[crop.slices])
    assert torch.equal(part.info["radii"], full.info["radii"])


def test_residuals_are_summed_by_weight_and_place():
    """A loop over pixels, in which a weight is the gradient of the picture by a colour."""
    gaussians, frozen = random_gaussians(6), random_gaussians(5, seed=7)
    crop = Crop(9, 5, 12, 8)
    residual = probe(crop.height, crop.width)[..., :4]
    dark = replace(gaussians, features_dc=torch.zeros_like(gaussians.features_dc).requires_grad_())
    naive = naive_rasterize(dark, VIEW, sh_degree=0, crop=crop, frozen=frozen)
    expected = torch.zeros(6, 10, dtype=torch.float64)
    for y, x in itertools.product(range(crop.height), range(crop.width)):
        (gradient,) = torch.autograd.grad(naive.color[y, x, 0], dark.features_dc, retain_graph=True)
        weight, r = gradient.flatten(1)[:, :1] / SH_C0, residual[y, x, :3]
        place = torch.tensor([crop.x + x + 0.5, crop.y + y + 0.5]) - naive.means2d.detach()
        parts = residual[y, x, 3:].expand(6, 1), r.expand(6, 3), place[:, :1] * r, place[:, 1:] * r
        expected += weight * torch.cat(parts, dim=1)

    shot = Shot(VIEW, crop, EAGER.project(frozen, VIEW))
    (raster,) = EAGER.draw(as_leaves(gaussians), [shot], sh_degree=1, residual_sums=True)
    raster.info["sums"].ask([residual])
    raster.color.sum().backward()
    assert raster.info["sums"].values.shape == (1, 6, 10)
    assert relative_error(raster.info["sums"].values[0], expected) < 1e-9


def test_weighing_adds_up_what_gaussians_fill_and_changes_nothing_else():
    """A weight is the gradient of the picture's sum by the colour, for which the naive twin is asked."""
    gaussians, frozen = random_gaussians(12), random_gaussians(8, seed=7)
    shot = Shot(VIEW, CROP, EAGER.project(frozen, VIEW))
    counts = probe(CROP.height, CROP.width)[..., 0]
    dark = replace(gaussians, features_dc=torch.zeros_like(gaussians.features_dc).requires_grad_())
    naive = naive_rasterize(dark, VIEW, sh_degree=0, crop=CROP, frozen=frozen)
    (expected,) = torch.autograd.grad((naive.color[..., 0] * counts).sum(), dark.features_dc)

    plain, leaves = as_leaves(gaussians), as_leaves(gaussians)
    (without,), (raster,) = (
        EAGER.draw(g, [shot], sh_degree=0, blend_weights=blend_weights)
        for g, blend_weights in ((plain, False), (leaves, True))
    )
    without.color.sin().sum().backward()
    (raster.color.sin().sum() + (raster.depth * counts).sum()).backward()
    found = raster.info["weights"].grad
    assert found.shape == (1, 12)
    assert float(found.abs().max()) > 1
    assert relative_error(found[0], expected.flatten(1)[:, 0] / SH_C0) < 1e-10
    assert torch.equal(raster.color, without.color)
    assert bool((raster.depth == 0).all())
    for name in PARAM_NAMES:
        assert torch.equal(getattr(leaves, name).grad, getattr(plain, name).grad), name


def test_what_cannot_be_seen_leaves_nothing_and_no_gradient_breaks():
    gaussians = random_gaussians(6)
    z = torch.tensor([-3.0, 0.0, 0.005, -1e-9, 2e10, 1e6], dtype=torch.float64)
    center, forward = VIEW.center, VIEW.viewmat[2, :3]
    leaves = as_leaves(replace(gaussians, means=center + z[:, None] * forward))
    raster = EAGER(leaves, VIEW, sh_degree=3, antialiased=True)
    stacked(raster).sum().backward()
    assert raster.info["radii"][0, :5].tolist() == [0] * 5
    for name, value in leaves.items():
        assert value.grad.isfinite().all(), name
        assert not value.grad[:5].any(), name


def test_needles_and_oversized_gaussians_have_finite_gradients_in_float32():
    gaussians = random_gaussians(8, dtype=torch.float32)
    scales = torch.tensor([[-12.0, -12, 3], [6, 6, 6], [-20, -20, -20], [3, -9, -9]]).repeat(2, 1)
    view = small_view(dtype=torch.float32)
    draw = partial(EAGER, view=view, sh_degree=3, antialiased=True)
    image, grads = gradients(draw, replace(gaussians, scales=scales))
    assert image.isfinite().all()
    assert all(grad.isfinite().all() for grad in grads.values())


def test_equal_depths_are_drawn_in_the_order_of_their_index():
    flat = random_gaussians(2, sh_degree=0)
    flat.means[:] = torch.tensor([0.0, 0, 4])
    flat.scales[:], flat.opacities[:] = 0.0, 3.0
    flat.features_dc[:] = torch.tensor([[1.0, -1, -1], [-1, 1, -1]])
    color = EAGER(flat, VIEW, sh_degree=0).color
    assert color[10, 18, 0] > color[10, 18, 1]
    swapped = EAGER(flat[torch.tensor([1, 0])], VIEW, sh_degree=0).color
    assert swapped[10, 18, 1] > swapped[10, 18, 0]


@BOTH
def test_what_is_kept_of_a_camera_holds_no_gradient_back(draw):
    """Not if it was first drawn in inference mode, nor if each of two drawings tells of its pose."""
    gaussians, fixed = as_leaves(random_gaussians(12)), replace(VIEW)
    with torch.inference_mode():
        draw(gaussians, fixed, sh_degree=1)
    moving = replace(VIEW, viewmat=VIEW.viewmat.clone().requires_grad_())
    found = []
    for view in (fixed, moving, moving):
        draw(gaussians, view, sh_degree=1).color.sum().backward()
        found.append(gaussians.means.grad.clone())
    assert torch.allclose(found[0], found[2] / 3)
    assert bool(moving.viewmat.grad.any())


def test_clear_errors():
    gaussians = random_gaussians(3, sh_degree=1)
    with pytest.raises(ValueError, match="sh_degree is 2"):
        EAGER(gaussians, VIEW, sh_degree=2)
    for grid in (TileGrid(CROP, 4), TileGrid(VIEW.full, 2)):
        with pytest.raises(ValueError, match="has not all tiles of"):
            drawn(EAGER, gaussians, VIEW, sh_degree=0, z_window=random_window(grid))
    with pytest.raises(ValueError, match="CUDA device"):
        make_rasterizer("gsplat", "cpu")
    assert make_rasterizer("auto", "cpu").name == EAGER.name
