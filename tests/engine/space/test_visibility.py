"""Visibility: what a Gaussian draws, found by looking at every pixel, against what is predicted."""

import math

import pytest
import torch
from gsplat.cuda._torch_impl import _fully_fused_projection, _quat_scale_to_covar_preci
from hypothesis import given
from hypothesis import strategies as st

from abcd_ns.engine.render.extents import extents_of
from abcd_ns.engine.render.primitive import DRAWN_SIGMAS, SPLATS
from abcd_ns.engine.render.tile_grid import TileGrid
from abcd_ns.engine.space.intervals import ray_directions
from abcd_ns.engine.space.tree import Box
from abcd_ns.engine.space.visibility import (
    footprint,
    reach_radius,
    reaches,
    widest_slant,
    world_size,
)
from abcd_ns.engine.types import Crop, Gaussians, View
from tests.engine.space.test_tree import SEEDS


def small_view(seed: int = 0) -> View:
    """40x30 px, about 70 degrees wide, at a random place."""
    generator = torch.Generator().manual_seed(seed)
    viewmat = torch.eye(4)
    viewmat[:3, :3] = torch.linalg.qr(torch.randn(3, 3, generator=generator)).Q
    viewmat[:3, 3] = torch.randn(3, generator=generator)
    return View(viewmat, torch.tensor([[28.0, 0, 19], [0, 26.0, 16], [0, 0, 1]]), width=40, height=30)


def footprint_of(means2d, radii, view: View, margin: int = 0, align: int = 16) -> Crop | None:
    return footprint(extents_of(means2d, radii, view).tolist(), view, margin, align)


def naive_footprint(means2d, radii, view: View, margin: int, align: int) -> Crop | None:
    """By marking pixels: those of the image in the tiles that a square touches, then their bounds, grown."""
    marked = []
    for (x, y), r in zip(means2d.tolist(), radii.tolist(), strict=True):
        for column in range(view.width):
            for row in range(view.height):
                touched = x - r < column + 1 and x + r > column and y - r < row + 1 and y + r > row
                if r > 0 and touched:
                    marked.append((column, row))
    if not marked:
        return None
    span = []
    for axis, size in ((0, view.width), (1, view.height)):
        low, high = min(m[axis] for m in marked) - margin, max(m[axis] for m in marked) + margin
        low, high = max(math.floor(low / align) * align, 0), min((high // align + 1) * align, size)
        span.append((low, high - low))
    return Crop(span[0][0], span[1][0], span[0][1], span[1][1])


@given(SEEDS, st.integers(0, 4), st.sampled_from([0, 3, 11]), st.sampled_from([1, 4, 16]))
def test_footprint_is_the_bounds_of_the_pixels_touched(seed, n, margin, align):
    generator = torch.Generator().manual_seed(seed)
    means2d = torch.rand(n, 2, generator=generator) * 80 - 20
    means2d = means2d.where(torch.rand(n, 1, generator=generator) < 0.5, means2d.round())
    radii = torch.randint(0, 6, (n,), generator=generator, dtype=torch.int32)
    expected = naive_footprint(means2d, radii, small_view(), margin, align)
    assert footprint_of(means2d, radii, small_view(), margin, align) == expected


def test_footprint_of_a_giant_is_the_image():
    view = small_view()
    crop = footprint_of(torch.tensor([[1e30, 0.0], [20.0, -1e9]]), torch.tensor([0, 2_000_000_000]), view)
    assert crop == view.full


def test_footprint_ignores_what_is_culled_whatever_its_place():
    means2d = torch.tensor([[math.nan, 3.0], [5.0, 5.0]])
    crop = footprint_of(means2d, torch.tensor([0, 2], dtype=torch.int32), small_view(), align=1)
    assert crop == Crop(3, 3, 4, 4)


def random_gaussians(seed: int, n: int) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=torch.randn(n, 3, generator=generator) * 3,
        scales=torch.randn(n, 3, generator=generator) - 1.5,
        quats=torch.randn(n, 4, generator=generator),
        features_dc=torch.zeros(n, 3),
        features_rest=torch.zeros(n, 0, 3),
        opacities=torch.zeros(n, 1),
    )


def project(gaussians: Gaussians, view: View):
    """(means2d, radii, depths, conics), by gsplat's reference."""
    quats = torch.nn.functional.normalize(gaussians.quats, dim=-1)
    covars, _ = _quat_scale_to_covar_preci(quats, gaussians.scales.exp(), True, False, triu=False)
    radii, means2d, depths, conics, _ = _fully_fused_projection(
        gaussians.means, covars, view.viewmat[None], view.K[None], view.width, view.height
    )
    return means2d[0], radii[0], depths[0], conics[0]


def drawn_in_box(view: View, crop: Crop, box: Box, means2d, radii, depths, conics) -> torch.Tensor:
    """Whether any pixel of the crop has a fragment (alpha >= 1/255 at opacity 1) inside the box, [n]."""
    dx = torch.arange(crop.x, crop.x + crop.width) + 0.5 - means2d[:, 0, None, None]
    dy = torch.arange(crop.y, crop.y + crop.height)[:, None] + 0.5 - means2d[:, 1, None, None]
    a, b, c = conics.T[..., None, None]
    drawn = torch.exp(-0.5 * (a * dx**2 + c * dy**2) - b * dx * dy) >= 1 / 255
    directions = ray_directions(view, TileGrid(crop, 1)).view(3, crop.height, crop.width)
    along = depths.double()[:, None, None, None] * directions.double()
    points = (view.center.double()[:, None, None] + along).movedim(1, -1)
    inside = box.contains(points.reshape(-1, 3)).reshape(drawn.shape)
    return (radii > 0) & (drawn & inside).flatten(1).any(dim=1)


@given(SEEDS, st.booleans())
def test_no_gaussian_draws_in_a_box_it_is_said_not_to_reach(seed, cropped):
    view, gaussians = small_view(seed), random_gaussians(seed, 40)
    crop = Crop(8, 5, 20, 13) if cropped else view.full
    means2d, radii, depths, conics = project(gaussians, view)
    middle = view.center.double() + view.viewmat[2, :3].double() * 3
    box = Box(middle - 0.7, torch.tensor([math.inf, 0.5, 0.9]).double() + middle)
    truth = drawn_in_box(view, crop, box, means2d, radii, depths, conics)
    blur = world_size(SPLATS.blur_pixels, depths.clamp(min=0), view)
    anywhere = reaches(gaussians.means, gaussians.scales, box, blur, widest_slant(view))
    assert not bool((truth & ~anywhere).any())


def test_the_tests_of_reach_are_not_vacuous():
    view, gaussians = small_view(1), random_gaussians(1, 400)
    means2d, radii, depths, conics = project(gaussians, view)
    middle = view.center.double() + view.viewmat[2, :3].double() * 3
    box = Box(middle - 1.2, middle + 1.2)
    truth = drawn_in_box(view, view.full, box, means2d, radii, depths, conics)
    blur = world_size(SPLATS.blur_pixels, depths.clamp(min=0), view)
    anywhere = reaches(gaussians.means, gaussians.scales, box, blur, widest_slant(view))
    assert int(truth.sum()) >= 20
    assert int(anywhere.sum()) < 400


def test_reach_is_measured_to_the_nearest_point_of_the_box():
    gaussians = random_gaussians(0, 3)
    gaussians.means.copy_(torch.tensor([[0.5, 0.5, 0.5], [4.0, 5.0, 0.5], [-9.0, 0.5, 0.5]]))
    gaussians.scales.copy_(torch.log(torch.tensor([[0.1, 0.1, 0.1], [0.1, 1.0, 0.2], [1.0, 1.0, 1.0]])))
    box = Box(torch.zeros(3).double(), torch.ones(3).double())
    radii = [0.1 * DRAWN_SIGMAS, DRAWN_SIGMAS, DRAWN_SIGMAS]
    assert reach_radius(gaussians.scales).tolist() == pytest.approx(radii)
    shapes = gaussians.means, gaussians.scales
    # Distances 0, 5 and 9.
    assert reaches(*shapes, box, slant=1.0).tolist() == [True, False, False]
    assert reaches(*shapes, box, slack=1.7, slant=1.0).tolist() == [True, True, False]
    assert reaches(*shapes, box, slant=3.0).tolist() == [True, True, True]
    of_each = torch.tensor([0.0, 0.0, 6.0])
    assert reaches(*shapes, box, slack=of_each, slant=1.0).tolist() == [True, False, True]
