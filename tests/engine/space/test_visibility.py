"""Visibility: what a Gaussian draws, found by looking at every pixel, against what is predicted."""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from abcd_ns.engine.layers.layer_renderer import RenderSettings, Seen
from abcd_ns.engine.render import TorchRasterizer
from abcd_ns.engine.render.projection import SPLATS, Splats, extents_of
from abcd_ns.engine.render.z_window import TileGrid
from abcd_ns.engine.space.distances import as_trained
from abcd_ns.engine.space.intervals import ray_directions
from abcd_ns.engine.space.partition import build_kd
from abcd_ns.engine.space.tree import EVERYWHERE, Box
from abcd_ns.engine.space.visibility import (
    BOUNDS_SLANT,
    ROUNDING,
    Frusta,
    Optics,
    bounds_of,
    footprint,
)
from abcd_ns.engine.types import NEAR_PLANE, Crop, View
from tests.engine.space.test_tree import SEEDS
from tests.reference.rasterizer_scenes import assert_same_layer
from tests.reference.scenes import WatchedScene, random_gaussians, renderer_of, ring_of_views


def small_view(seed: int = 0) -> View:
    """40x30 px, about 70 degrees wide, at a random place."""
    generator = torch.Generator().manual_seed(seed)
    viewmat = torch.eye(4)
    viewmat[:3, :3] = torch.linalg.qr(torch.randn(3, 3, generator=generator)).Q
    viewmat[:3, 3] = torch.randn(3, generator=generator)
    return View(viewmat, torch.tensor([[28.0, 0, 19], [0, 26.0, 16], [0, 0, 1]]), width=40, height=30)


def footprint_of(means2d, radii, view: View, margin: int = 0) -> Crop | None:
    return footprint(extents_of(means2d, radii, view).tolist(), view, margin)


def naive_footprint(means2d, radii, view: View, margin: int, align: int = 16) -> Crop | None:
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


@given(SEEDS, st.integers(0, 4), st.sampled_from([0, 3, 11]))
def test_footprint_is_the_bounds_of_the_pixels_touched(seed, n, margin):
    generator = torch.Generator().manual_seed(seed)
    means2d = torch.rand(n, 2, generator=generator) * 80 - 20
    means2d = means2d.where(torch.rand(n, 1, generator=generator) < 0.5, means2d.round())
    radii = torch.randint(0, 6, (n,), generator=generator, dtype=torch.int32)
    expected = naive_footprint(means2d, radii, small_view(), margin)
    assert footprint_of(means2d, radii, small_view(), margin) == expected


@pytest.mark.parametrize(
    ("means2d", "radii", "expected"),
    [
        ([[1e30, 0.0], [20.0, -1e9]], [0, 2_000_000_000], Crop(0, 0, 40, 30)),
        ([[math.nan, 3.0], [5.0, 5.0]], [0, 2], Crop(0, 0, 16, 16)),  # what is culled may be anywhere
    ],
)
def test_footprints_of_what_is_huge_or_nowhere(means2d, radii, expected):
    assert footprint_of(torch.tensor(means2d), torch.tensor(radii), small_view()) == expected


def drawn_in_box(view: View, crop: Crop, box: Box, splats: Splats) -> torch.Tensor:
    """Whether any pixel of the crop has a fragment (alpha >= 1/255 at opacity 1) inside the box, [n]."""
    dx = torch.arange(crop.x, crop.x + crop.width) + 0.5 - splats.means2d[:, 0, None, None]
    dy = torch.arange(crop.y, crop.y + crop.height)[:, None] + 0.5 - splats.means2d[:, 1, None, None]
    a, b, c = splats.shapes.T[..., None, None]
    drawn = torch.exp(-0.5 * (a * dx**2 + c * dy**2) - b * dx * dy) >= 1 / 255
    directions = ray_directions(view, TileGrid(crop, 1)).view(3, crop.height, crop.width)
    along = splats.depths.double()[:, None, None, None] * directions.double()
    points = (view.center.double()[:, None, None] + along).movedim(1, -1)
    inside = box.contains(points.reshape(-1, 3)).reshape(drawn.shape)
    return (splats.radii > 0) & (drawn & inside).flatten(1).any(dim=1)


def drawn_and_reached(seed: int, count: int, crop: Crop | None = None):
    """Which Gaussians draw in a box around a point before the camera, and which are said to reach it."""
    view, gaussians = small_view(seed), random_gaussians(count, seed, size=0.22)
    gaussians.means[:] *= 3  # so that some are beside the camera, and behind it
    splats = TorchRasterizer(use_native=False).project(gaussians, view)
    middle = view.center.double() + view.viewmat[2, :3].double() * 3
    box = Box(middle - 0.7, middle + torch.tensor([math.inf, 0.5, 0.9]))
    reached = Optics([view], SPLATS.blur_pixels).reaches(gaussians.means, gaussians.scales, box)
    return drawn_in_box(view, crop or view.full, box, splats), reached


@given(SEEDS, st.sampled_from([None, Crop(8, 5, 20, 13)]))
def test_no_gaussian_draws_in_a_box_it_is_said_not_to_reach(seed, crop):
    drawn, reached = drawn_and_reached(seed, 40, crop)
    assert not bool((drawn & ~reached).any())


def test_some_draw_in_a_box_and_some_do_not_reach_it():
    drawn, reached = drawn_and_reached(1, 400)
    assert int(drawn.sum()) >= 20
    assert int(reached.sum()) < 400


def ahead(view, distance, count=1):
    """Points on the view's axis."""
    return (view.center + distance * view.viewmat[2, :3]).expand(count, 3)


def test_the_near_plane_is_half_the_least_distance_that_a_photo_shows():
    (view,) = ring_of_views(1)
    beside, wrong_match = ahead(view, 0.1) + 10 * view.viewmat[0, :3], ahead(view, 0.05)
    for points, expected in (
        ((ahead(view, 2.0), ahead(view, 0.8), ahead(view, 2.5)), 0.4),
        ((ahead(view, 2.0), beside, ahead(view, -0.1)), 1.0),
        ((ahead(view, 2.0, 5000), wrong_match), 1.0),
        ((torch.zeros(0, 3),), NEAR_PLANE),
        ((ahead(view, -5.0),), NEAR_PLANE),
    ):
        assert as_trained([view], torch.cat(points))[0].near == pytest.approx(expected, rel=1e-2)


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


# Culling by bounds: what is passed over could not have been drawn

DRAW = TorchRasterizer()
SETTINGS = RenderSettings(sh_degree=1)


def corners(*boxes: Box) -> torch.Tensor:
    return torch.stack([torch.stack((box.lower, box.upper)) for box in boxes])


@given(
    seed=st.integers(0, 10_000),
    size=st.sampled_from([0.01, 0.1, 0.6]),
    where=st.tuples(*[st.floats(-4, 4)] * 3),
    crop=st.sampled_from([None, Crop(0, 0, 16, 8), Crop(32, 16, 16, 16)]),
)
def test_what_may_not_show_draws_nothing(seed, size, where, crop):
    """Blocks beside, behind and around the cameras, inside crops and outside."""
    gaussians = random_gaussians(12, size=size, seed=seed, dtype=torch.float64)
    gaussians.means[:] = gaussians.means + torch.tensor(where, dtype=torch.float64)
    views = ring_of_views(3, dtype=torch.float64)
    seen = [(view, crop or view.full) for view in views]
    every = torch.ones(1, len(seen), dtype=torch.bool)
    shows, crops = Frusta(seen, DRAW.slack).crops(corners(bounds_of(gaussians)), every)
    for (view, crop), shown in zip(seen, shows[0].tolist(), strict=True):
        drawn = DRAW(gaussians, view, crop=crop, sh_degree=0).layer
        if shown and (part := crops.get(view.index)) is not None:
            drawn.transmittance[part.within(crop).slices] = 1
        assert bool((drawn.transmittance == 1).all())


@given(seed=st.integers(0, 1000), spread=st.sampled_from([0.5, 2.0, 9.0]))
def test_frusta_hold_what_their_cameras_see(seed, spread):
    points = spread * torch.randn(5, 3, generator=torch.Generator().manual_seed(seed)).double()
    views = ring_of_views(6, dtype=torch.float64)
    frusta = Frusta([(view, view.full) for view in views], -ROUNDING)
    held = frusta.may_show(points[:, None].expand(-1, 2, -1)).any(dim=0)
    assert held.tolist() == [bool(view.depths_of(points)[1].any()) for view in views]


def test_a_box_without_end_may_always_show():
    (view,) = ring_of_views(1)
    frusta = Frusta([(view, view.full)], DRAW.slack)
    assert frusta.may_show(corners(EVERYWHERE)).tolist() == [[True]]
    assert frusta.may_show(torch.zeros(0, 2, 3).double()).shape == (0, 1)
    assert Frusta([], DRAW.slack).may_show(corners(EVERYWHERE)).shape == (1, 0)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_what_is_not_finite_is_never_passed_over(bad):
    gaussians = random_gaussians(5)
    gaussians.means[2, 1] = bad
    assert bounds_of(gaussians) is EVERYWHERE
    assert bounds_of(gaussians[:0]) is None


def test_too_wide_a_lens_switches_bounds_off():
    views = ring_of_views(2)
    optics, box = Optics(views, DRAW.slack), Box(torch.zeros(3).double(), torch.ones(3).double())
    assert bool(optics.drawn_within([box]).isfinite().all())
    optics.slant = BOUNDS_SLANT + 0.1
    assert not optics.drawn_within([box]).isfinite().any()


@pytest.mark.parametrize("ownership", ["fragments", "means"])
def test_blocks_out_of_sight_are_not_read_and_the_picture_is_the_same(ownership):
    """Of clusters in a row, far apart, each in a cell of its own."""
    gaussians = random_gaussians(80, size=0.03, dtype=torch.float64)
    gaussians.means[:, 0] += 40.0 * (torch.arange(80) // 10)
    views = ring_of_views(3, dtype=torch.float64)  # around the first cluster
    tree = build_kd(gaussians.means, 8)
    scene = WatchedScene(tree, gaussians)
    renderer = renderer_of(scene, DRAW, ownership=ownership)
    for view in views:
        assert_same_layer(renderer.picture(view, SETTINGS), DRAW(gaussians, view, sh_degree=1), atol=1e-12)
    assert len(set(scene.read)) < 8
    assert int(tree.assign(torch.zeros(1, 3))[0]) in scene.read


def test_few_parts_are_held_while_nodes_are_folded():
    (view,), parts, most = ring_of_views(1), {}, 0
    seen, renderer = (
        Seen(view, view.full),
        renderer_of(random_gaussians(128), DRAW, blocks=32, ownership="means"),
    )
    for node, shown in renderer.shown(renderer.nodes(0), [(view, view.full)], exclude=0).items():
        (parts[node],) = renderer.render(node, renderer.load(shown), [seen], SETTINGS, 0)
        renderer.fold_up(parts, node, seen)
        most = max(most, len(parts))
    assert list(parts) == [0]
    assert most <= 6  # one for each level of a tree of 32, and the one that came last
