"""The first Gaussians: no more than there may be, and one for points that no view can tell apart."""

import math
import warnings

import pytest
import torch

from abcd_ns.engine.gaussians.initialize import (
    THICKNESS,
    PointCloud,
    cloud_from_points,
    finest_pixel,
    random_points,
    spacing,
    split_off,
    thin_points,
)
from tests.reference.scenes import ring_of_views

VIEWS = ring_of_views(6)


@pytest.fixture(scope="module")
def many() -> PointCloud:
    return cloud_from_points(*random_points(400, 2.0), sh_degree=0)


def rows(gaussians: PointCloud) -> set[tuple[float, ...]]:
    return {tuple(row) for row in gaussians.means.tolist()}


@pytest.mark.parametrize("limit", [1, 50, 399])
def test_of_too_many_a_choice_begins(many, limit):
    assert split_off(many, len(many), seed=0)[0] is many
    few, others = split_off(many, limit, seed=0)
    assert len(few) == limit
    assert rows(few) | rows(others) == rows(many)
    assert not rows(few) & rows(others)
    again, other = (rows(split_off(many, limit, seed)[0]) for seed in (0, 1))
    assert again == rows(few) != other


def test_fewer_gaussians_are_wider_so_that_no_gaps_are_left(many):
    few, _ = split_off(many, 50, seed=0)
    before = {tuple(mean): scale for mean, scale in zip(many.means.tolist(), many.scales, strict=True)}
    for mean, scale in zip(few.means.tolist(), few.scales, strict=True):
        assert bool((scale >= before[tuple(mean)]).all())
    # Eight times fewer in a volume are twice as far apart.
    assert float(few.scales.mean() - many.scales.mean()) == pytest.approx(math.log(2), abs=0.2)


@pytest.mark.parametrize(
    ("points", "warns"),
    [
        (torch.zeros(0, 3), True),
        (torch.eye(3), True),
        (torch.zeros(5, 3), True),
        (torch.eye(4, 3), False),
        (torch.linspace(0, 1, 5)[:, None].expand(5, 3), False),
    ],
)
def test_too_few_points_are_warned_of_and_give_numbers_all_the_same(points, warns):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        made = cloud_from_points(points, torch.zeros(len(points), 3)).gaussians()
    assert ["too few" in str(warning.message) for warning in caught] == [True] * warns
    assert len(made) == len(points)
    assert all(bool(torch.isfinite(value).all()) for _, value in made.items())


@pytest.mark.parametrize("chunk", [7, 1000])
def test_a_point_is_as_wide_as_its_three_nearest_are_far(monkeypatch, chunk):
    monkeypatch.setattr("abcd_ns.engine.gaussians.initialize.CHUNK", chunk)
    points, _ = random_points(50, 2.0)
    points[10:13] = points[9]  # four in one place
    expected = torch.cdist(points.double(), points.double()).sort(dim=1).values[:, 1:4].mean(dim=1)
    expected[9:13] = expected[expected > 0].min()
    torch.testing.assert_close(spacing(points), expected.float(), rtol=1e-6, atol=0)


def test_surfels_begin_flat_and_stay_so_where_they_are_widened():
    points = torch.rand(40, 3, generator=torch.Generator().manual_seed(0))
    discs = cloud_from_points(points, torch.zeros(40, 3), flat=True)
    chosen, others = split_off(discs, 10, seed=0)
    assert all(bool((part.gaussians().scales[:, 2] == THICKNESS).all()) for part in (chosen, others))
    assert bool((chosen.gaussians().scales[:, :2] > discs.scales.mean()).all())


def test_a_pixel_is_as_wide_as_the_nearest_view_that_sees_the_point_has_it():
    points = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.2, 0.1], [0.0, 0.0, 90.0]])
    found = finest_pixel(points, VIEWS)
    for point, width in zip(points, found, strict=True):
        seen = []
        for view in VIEWS:
            x, y, z = (view.viewmat[:3, :3] @ point + view.viewmat[:3, 3]).tolist()
            u, v = (view.K[0, 0] * x / z + view.K[0, 2], view.K[1, 1] * y / z + view.K[1, 2])
            if z > view.near and 0 <= u < view.width and 0 <= v < view.height:
                seen.append(z / float(view.K[0, 0]))
        torch.testing.assert_close(float(width), min(seen, default=float("inf")), rtol=1e-5, atol=0)
    assert found[2].isinf()


def by_cube(points, colors, pixels: float) -> dict[tuple, list[torch.Tensor]]:
    """Rows of place and colour by cube, one point after the other; unseen points have cubes of their own."""
    cubes: dict[tuple, list[torch.Tensor]] = {}
    for row, (point, size) in enumerate(zip(points, pixels * finest_pixel(points, VIEWS), strict=True)):
        level = math.floor(math.log2(size)) if size.isfinite() else None
        cube = (-1000, row) if level is None else (level, *(point.double() / 2.0**level).floor().tolist())
        cubes.setdefault(cube, []).append(torch.cat((point, colors[row])).double())
    return cubes


@pytest.mark.parametrize("chunk", [7, 1000])
def test_points_of_a_cube_become_their_mean_cubes_in_order(monkeypatch, chunk):
    monkeypatch.setattr("abcd_ns.engine.gaussians.initialize.CHUNK", chunk)
    points, colors = random_points(200, 0.3, seed=6)
    points[::11] += 400.0  # unseen
    assert thin_points(points, colors, VIEWS, 0.0)[0] is points
    cubes = by_cube(points, colors, 3.0)
    found = torch.cat(thin_points(points, colors, VIEWS, 3.0), dim=1)
    assert 60 < len(found) == len(cubes) < 190
    expected = torch.stack([torch.stack(cubes[cube]).mean(dim=0) for cube in sorted(cubes)])
    torch.testing.assert_close(found, expected.float(), rtol=1e-6, atol=1e-6)
