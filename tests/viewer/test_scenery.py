import itertools

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from abcd_ns.engine.space.partition import build_kd
from abcd_ns.engine.space.tree import Box
from abcd_ns.viewer.scenery import (
    LIFT,
    SCENE_SCALE,
    boxes_of,
    bulk,
    edges_of,
    first_look,
    nearest_view,
    views_that_see,
)
from tests.reference.scenes import ring_of_views


def box(lower: tuple[float, ...], upper: tuple[float, ...]) -> Box:
    return Box(torch.tensor(lower, dtype=torch.float64), torch.tensor(upper, dtype=torch.float64))


def points(count: int = 4000, seed: int = 0) -> torch.Tensor:
    return torch.rand((count, 3), generator=torch.Generator().manual_seed(seed)) * 2 - 1


def test_outliers_do_not_stretch_the_bulk():
    scene = points()
    far = torch.cat([scene, torch.full((40, 3), 1e7), torch.full((3, 3), float("nan"))])
    plain, found = bulk(scene), bulk(far)
    assert float((plain.upper - found.upper).abs().max()) < 0.1
    assert bool((found.upper < 1.2).all())
    assert bool((found.lower > -1.2).all())
    for few in map(bulk, (points(0), points(1), points(2))):
        assert bool((few.upper > few.lower).all())


@given(st.integers(1, 12), st.integers(0, 1000))
def test_boxes_are_finite_inside_their_cells_and_apart(blocks, seed):
    scene = points(500, seed)
    tree, bounds = build_kd(scene, blocks), bulk(scene)
    found = boxes_of(tree, bounds)
    assert sorted(found) == list(range(blocks))
    for block, shown in found.items():
        cell = tree.cell(block)
        assert bool((shown.lower >= torch.maximum(cell.lower, bounds.lower)).all())
        assert bool((shown.upper <= torch.minimum(cell.upper, bounds.upper)).all())
        assert bool((shown.lower < shown.upper).all())
        for other in (found[b] for b in found if b != block):
            apart = torch.maximum(shown.lower, other.lower) >= torch.minimum(shown.upper, other.upper)
            assert bool(apart.any())


def test_a_cell_beyond_the_bulk_has_no_box():
    tree = build_kd(points() * torch.tensor([9.0, 1.0, 1.0]), 2)
    assert float(tree.cell(0).upper[0]) < 1
    (only,) = boxes_of(tree, box((1, 0, 0), (2, 1, 1)))
    assert only == 1


def test_a_line_follows_all_edges_and_nothing_else():
    line = edges_of(box((0, 0, 0), (1, 2, 3)))
    edges = {frozenset(pair) for pair in itertools.pairwise(line)}
    assert len(edges) == 12
    assert all(sum(a != b for a, b in zip(*edge, strict=True)) == 1 for edge in edges)
    assert set(line) == set(itertools.product((0, 10), (0, 20), (0, 30)))


def test_the_nearest_view_is_close_and_looks_the_same_way():
    views = ring_of_views(8)
    for view in views:
        eye, forward = (view.center * SCENE_SCALE).numpy(), view.viewmat[2, :3].numpy()
        assert nearest_view(0.9 * eye, forward, views).index == view.index
    assert nearest_view(0 * eye, forward, views).index == view.index  # in the middle the direction decides
    assert nearest_view(eye, forward, []) is None


def test_views_that_see():
    views = ring_of_views(8)
    assert views_that_see(torch.zeros(1, 3), views) == views
    assert views_that_see(torch.tensor([[0.0, 0.0, 1e4]]), views) == []
    assert views_that_see(torch.zeros(0, 3), views) == []
    # A twentieth of the points suffices.
    behind = views[0].center * 2
    for count, found in ((19, views[:1]), (21, [])):
        some = torch.cat([torch.zeros(1, 3), behind.expand(count - 1, 3)])
        assert views_that_see(some, views[:1]) == found


def test_the_first_look_is_from_the_farthest_camera():
    views, shown = ring_of_views(8), box((-1, -1, -1), (3, 1, 1))
    eye, target = first_look(shown, views)
    assert target.tolist() == [SCENE_SCALE, 0.0, 0.0]
    distances = [float((view.center - torch.tensor([1.0, 0.0, 0.0])).norm()) for view in views]
    farthest = views[distances.index(max(distances))]
    assert eye[:2].tolist() == pytest.approx((farthest.center[:2] * SCENE_SCALE).tolist())
    above = LIFT * max(distances) * SCENE_SCALE
    assert eye[2] == pytest.approx(float(farthest.center[2]) * SCENE_SCALE + above, rel=1e-5)
    assert first_look(shown, [])[0].tolist()[:2] == [3 * SCENE_SCALE, SCENE_SCALE]
