"""Visibility: what a Gaussian draws, found by looking at every pixel, against what is predicted."""

import math
from dataclasses import replace

import pytest
import torch
from gsplat.cuda._torch_impl import _fully_fused_projection, _quat_scale_to_covar_preci
from hypothesis import given
from hypothesis import strategies as st

from abcd_ns.engine.render import TorchRasterizer
from abcd_ns.engine.render.primitive import DRAWN_SIGMAS, SPLATS
from abcd_ns.engine.render.projection import extents_of
from abcd_ns.engine.render.tile_grid import TileGrid
from abcd_ns.engine.space.distances import as_trained
from abcd_ns.engine.space.intervals import ray_directions
from abcd_ns.engine.space.tree import Box
from abcd_ns.engine.space.visibility import footprint, reach_radius, reaches, widest_slant, world_size
from abcd_ns.engine.types import NEAR_PLANE, Crop, Gaussians, View
from tests.engine.space.test_tree import SEEDS
from tests.reference.scenes import random_gaussians, ring_of_views


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


def test_footprint_of_an_oversized_gaussian_is_the_image():
    view = small_view()
    crop = footprint_of(torch.tensor([[1e30, 0.0], [20.0, -1e9]]), torch.tensor([0, 2_000_000_000]), view)
    assert crop == view.full


def test_footprint_ignores_what_is_culled_whatever_its_place():
    means2d = torch.tensor([[math.nan, 3.0], [5.0, 5.0]])
    crop = footprint_of(means2d, torch.tensor([0, 2], dtype=torch.int32), small_view(), align=1)
    assert crop == Crop(3, 3, 4, 4)


def scattered(seed: int, count: int) -> Gaussians:
    """Everywhere, so that a camera has some beside and behind it."""
    gaussians = random_gaussians(count, seed, size=0.22)
    gaussians.means[:] *= 3
    return gaussians


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


def drawn_and_reached(seed: int, count: int, crop: Crop | None, lower: float, upper: list[float]):
    """Which Gaussians draw in a box around a point before the camera, and which are said to reach it."""
    view, gaussians = small_view(seed), scattered(seed, count)
    means2d, radii, depths, conics = project(gaussians, view)
    middle = view.center.double() + view.viewmat[2, :3].double() * 3
    box = Box(middle + lower, torch.tensor(upper).double() + middle)
    blur = world_size(SPLATS.blur_pixels, depths.clamp(min=0), view)
    reached = reaches(gaussians.means, gaussians.scales, box, blur, widest_slant(view))
    return drawn_in_box(view, crop or view.full, box, means2d, radii, depths, conics), reached


@given(SEEDS, st.sampled_from([None, Crop(8, 5, 20, 13)]))
def test_no_gaussian_draws_in_a_box_it_is_said_not_to_reach(seed, crop):
    drawn, reached = drawn_and_reached(seed, 40, crop, -0.7, [math.inf, 0.5, 0.9])
    assert not bool((drawn & ~reached).any())


def test_some_draw_in_a_box_and_some_do_not_reach_it():
    drawn, reached = drawn_and_reached(1, 400, None, -1.2, [1.2, 1.2, 1.2])
    assert int(drawn.sum()) >= 20
    assert int(reached.sum()) < 400


def test_reach_is_measured_to_the_nearest_point_of_the_box():
    gaussians = random_gaussians(3)
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


def ahead(view, distance, count=1):
    """Points on the view's axis."""
    return (view.center + distance * view.viewmat[2, :3]).expand(count, 3)


def near_of(views, points):
    return as_trained(views, points)[0].near


def test_half_the_nearest_distance_in_any_view():
    views = ring_of_views(3)
    points = torch.cat((ahead(views[0], 2.0), ahead(views[1], 0.8), ahead(views[2], 2.5)))
    assert near_of(views, points) == pytest.approx(0.4, rel=1e-2)


def test_what_no_photo_shows_does_not_count():
    (view,) = ring_of_views(1)
    beside = ahead(view, 0.1) + 10 * view.viewmat[0, :3]
    behind = ahead(view, -0.1)
    assert near_of([view], torch.cat((ahead(view, 2.0), beside, behind))) == pytest.approx(1.0, rel=1e-3)


def test_a_wrong_match_in_thousands_does_not_count():
    (view,) = ring_of_views(1)
    points = torch.cat((ahead(view, 2.0, 5000), ahead(view, 0.05)))
    assert near_of([view], points) == pytest.approx(1.0, rel=1e-2)


def test_gsplats_own_where_nothing_is_known():
    views = ring_of_views(2)
    assert near_of(views, torch.zeros(0, 3)) == NEAR_PLANE
    assert near_of(views[:1], ahead(views[0], -5.0)) == NEAR_PLANE


def test_a_camera_far_away_changes_little_for_the_others():
    """Its frame is scaled down; the near plane is what it was, in pixels, and rates at most double."""
    views, points = ring_of_views(9), torch.randn(200, 3, generator=torch.Generator().manual_seed(0))
    far = replace(views[0], viewmat=views[0].viewmat.clone(), index=9)
    far.viewmat[2, 3] += 3000.0
    expected = as_trained(views, points)
    for scale in (1.0, 1e-3):
        seen = [replace(v, viewmat=v.viewmat.clone()) for v in (*views, far)]
        for view in seen:
            view.viewmat[:3, 3] *= scale
        for view, before in zip(as_trained(seen, points * scale), expected, strict=False):
            assert 0.99 < view.reach / (before.reach * scale) < 2.0
            assert view.near == pytest.approx(before.near * scale, rel=1e-3)
            assert view.nearest == pytest.approx(before.nearest * scale, rel=1e-3)


def test_two_sites_far_apart_are_trained_at_rates_of_their_own():
    """All cameras stand far from the middle, and what they see is near."""
    site, points = ring_of_views(6), torch.randn(200, 3, generator=torch.Generator().manual_seed(0))
    away = torch.tensor([5000.0, 0.0, 0.0])
    other = [replace(v, viewmat=v.viewmat.clone(), index=v.index + 6) for v in site]
    for view in other:
        view.viewmat[:3, 3] -= view.viewmat[:3, :3] @ away
    both = as_trained([*site, *other], torch.cat((points, points + away)))
    alone = as_trained(site, points)
    assert max(view.reach for view in both) < 6 * alone[0].reach
    assert [view.near for view in both] == pytest.approx([alone[0].near] * 12, rel=1e-3)


def test_a_view_that_sees_no_point_reaches_as_far_as_the_others():
    near, _ = ring_of_views(2)
    away = replace(near, viewmat=torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])) @ near.viewmat, index=1)
    found = as_trained([near, away], ahead(near, 0.2, 5))
    assert [view.reach for view in found] == pytest.approx([0.8, 0.8])
    assert [view.nearest for view in found] == pytest.approx([0.2, 0.0])
    assert as_trained([near], torch.zeros(0, 3))[0].reach == 1.0


def test_no_more_points_than_needed_are_looked_at():
    views = ring_of_views(5) * 200
    points = ahead(views[0], 2.0, 50_000)
    assert near_of(views, points) == pytest.approx(near_of(views[:5], points[:1]), rel=1e-3)


def test_a_gaussian_before_the_camera_spoils_no_picture():
    (view,) = ring_of_views(1)
    scene = random_gaussians(30, seed=3, size=0.2)
    blinder = replace(scene[:1], means=ahead(view, 0.1).clone(), opacities=torch.full((1, 1), 5.0))
    both = type(scene).cat([scene, blinder])
    draw = TorchRasterizer(use_native=False)
    clear = draw(scene, view, sh_degree=0).color
    assert float((draw(both, view, sh_degree=0).color - clear).abs().max()) > 0.1
    assert torch.equal(draw(both, replace(view, near=0.2), sh_degree=0).color, clear)
