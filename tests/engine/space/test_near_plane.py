from dataclasses import replace

import pytest
import torch

from abcd_ns.engine.render import TorchRasterizer
from abcd_ns.engine.space.near_plane import near_plane, with_distances
from abcd_ns.engine.types import NEAR_PLANE
from tests.reference.scenes import random_gaussians, ring_of_views


def ahead(view, distance, count=1):
    """Points on the view's axis."""
    return (view.center + distance * view.viewmat[2, :3]).expand(count, 3)


def test_half_the_nearest_distance_in_any_view():
    views = ring_of_views(3)
    points = torch.cat((ahead(views[0], 2.0), ahead(views[1], 0.8), ahead(views[2], 2.5)))
    assert near_plane(points, views) == pytest.approx(0.4, rel=1e-2)


def test_what_no_photo_shows_does_not_count():
    (view,) = ring_of_views(1)
    beside = ahead(view, 0.1) + 10 * view.viewmat[0, :3]
    behind = ahead(view, -0.1)
    assert near_plane(torch.cat((ahead(view, 2.0), beside, behind)), [view]) == pytest.approx(1.0, rel=1e-3)


def test_a_wrong_match_in_thousands_does_not_count():
    (view,) = ring_of_views(1)
    points = torch.cat((ahead(view, 2.0, 5000), ahead(view, 0.05)))
    assert near_plane(points, [view]) == pytest.approx(1.0, rel=1e-2)


def test_gsplats_own_where_nothing_is_known():
    views = ring_of_views(2)
    assert near_plane(torch.zeros(0, 3), views) == NEAR_PLANE
    assert near_plane(ahead(views[0], -5.0), views[:1]) == NEAR_PLANE


def test_a_camera_far_away_changes_nothing_for_the_others():
    """Its frame is scaled down; what the others see from how far is as before."""
    views, points = ring_of_views(4), torch.randn(200, 3, generator=torch.Generator().manual_seed(0))
    far = replace(views[0], viewmat=views[0].viewmat.clone(), index=4)
    far.viewmat[2, 3] += 3000.0
    for scale in (1.0, 1e-3):
        seen = [replace(v, viewmat=v.viewmat.clone()) for v in (*views, far)]
        for view in seen:
            view.viewmat[:3, 3] *= scale
        alone, beside = with_distances(points * scale, seen[:4]), with_distances(points * scale, seen)
        assert [view.distance for view in alone] == [view.distance for view in beside[:4]]
        assert alone[0].distance == pytest.approx(3.38 * scale, rel=1e-2)
        assert near_plane(points * scale, seen) == pytest.approx(near_plane(points, views) * scale, rel=1e-3)


def test_a_view_that_sees_no_point_is_as_far_as_the_others():
    near, other = ring_of_views(2)
    away = replace(near, viewmat=torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])) @ near.viewmat, index=1)
    points = ahead(near, 2.0, 5)
    assert [view.distance for view in with_distances(points, [near, away])] == pytest.approx([2.0, 2.0])
    assert [view.distance for view in with_distances(torch.zeros(0, 3), [near, other])] == [1.0, 1.0]


def test_no_more_points_and_views_than_needed_are_looked_at():
    views = ring_of_views(5) * 200
    points = ahead(views[0], 2.0, 50_000)
    assert near_plane(points, views) == pytest.approx(near_plane(points[:1], views[:5]), rel=1e-3)


def test_a_gaussian_before_the_camera_spoils_no_picture():
    (view,) = ring_of_views(1)
    scene = random_gaussians(30, seed=3, size=0.2)
    blinder = replace(scene[:1], means=ahead(view, 0.1).clone(), opacities=torch.full((1, 1), 5.0))
    both = type(scene).cat([scene, blinder])
    draw = TorchRasterizer(use_native=False)
    clear = draw(scene, view, sh_degree=0).color
    assert float((draw(both, view, sh_degree=0).color - clear).abs().max()) > 0.1
    assert torch.equal(draw(both, replace(view, near=0.2), sh_degree=0).color, clear)
