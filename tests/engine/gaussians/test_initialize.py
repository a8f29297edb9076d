"""The first Gaussians: no more than there may be, the same ones for the same seed, no gaps."""

import math
import warnings

import pytest
import torch

from abcd_ns.engine.gaussians.initialize import (
    THICKNESS,
    PointCloud,
    cloud_from_points,
    random_points,
    spacing,
    split_off,
    thin_out,
)


@pytest.fixture(scope="module")
def many() -> PointCloud:
    return cloud_from_points(*random_points(400, 2.0), sh_degree=0)


def rows(gaussians: PointCloud) -> set[tuple[float, ...]]:
    return {tuple(row) for row in gaussians.means.tolist()}


@pytest.mark.parametrize("limit", [None, 400, 1000])
def test_within_the_limit_all_begin_as_they_are(many, limit):
    assert thin_out(many, limit, seed=0) is many


@pytest.mark.parametrize("limit", [1, 50, 399])
def test_of_too_many_a_choice_begins(many, limit):
    few, others = split_off(many, limit, seed=0)
    assert len(few) == limit
    assert rows(few) == rows(thin_out(many, limit, seed=0))
    assert rows(few) | rows(others) == rows(many)
    assert not rows(few) & rows(others)


def test_the_seed_decides_which(many):
    chosen = [rows(thin_out(many, 50, seed)) for seed in (0, 0, 1)]
    assert chosen[0] == chosen[1] != chosen[2]


def test_fewer_gaussians_are_wider_so_that_no_gaps_are_left(many):
    few = thin_out(many, 50, seed=0)
    before = {tuple(mean): scale for mean, scale in zip(many.means.tolist(), many.scales, strict=True)}
    for mean, scale in zip(few.means.tolist(), few.scales, strict=True):
        assert bool((scale >= before[tuple(mean)]).all())
    # Eight times fewer in a volume are twice as far apart.
    assert float(few.scales.mean() - many.scales.mean()) == pytest.approx(math.log(2), abs=0.2)


@pytest.mark.parametrize(
    ("points", "warns"),
    [
        (torch.zeros(0, 3), True),
        (torch.zeros(1, 3), True),
        (torch.eye(3), True),
        (torch.zeros(5, 3), True),
        (torch.cat([torch.eye(3), torch.zeros(1, 3)]), False),
        (torch.linspace(0, 1, 5)[:, None] * torch.ones(1, 3), False),
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
