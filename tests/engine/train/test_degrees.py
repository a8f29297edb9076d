"""Harmonics that change less in a Gaussian's views than they cost go, and stay away."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from abcd_ns.engine.gaussians.spherical_harmonics import (
    SH_C0,
    count_parameters,
    degrees_in_use,
    sh_basis_rows,
)
from abcd_ns.engine.train.density import degrees
from abcd_ns.engine.train.density.control import DensityConfig
from abcd_ns.engine.train.density.degrees import GONE, lowered
from abcd_ns.engine.train.training_loop import train_step
from abcd_ns.engine.types import Gaussians, View
from tests.reference.scenes import (
    Photos,
    assert_resumes,
    random_gaussians,
    ring_of_views,
    steps_of,
    whole_scene,
)

STILL = DensityConfig(refine_start=1.0, refine_stop=0.0, min_contribution=1e-9)
"""Nothing grows, and nobody is pruned that fills anything."""
COEFFICIENTS = (1, 4, 9, 16)


def statistics(count: int, weight: float = 30.0) -> dict[str, torch.Tensor]:
    return {"weight": torch.full((count,), weight), "passes": torch.ones(count)}


def look(mean: torch.Tensor, size: float, view: View) -> tuple[np.ndarray, float]:
    """The harmonics in the direction of one Gaussian, and what the view counts for."""
    x, y, z = (view.viewmat[:3, :3] @ mean + view.viewmat[:3, 3]).tolist()
    away = (mean - view.center) / (mean - view.center).norm()
    basis = np.array([SH_C0, *(float(row) for row in sh_basis_rows(*away))])
    u, v = (float(view.K[i, i]) * p / z + float(view.K[i, 2]) for i, p in ((0, x), (1, y)))
    over = degrees.REACH * size * float(view.K[0, 0]) / z
    seen = z > view.near and -over < u < view.width + over and -over < v < view.height + over
    return basis, float(view.K[0, 0] / z) ** 2 if seen else 0.0


def slow(gaussians: Gaussians, row: int, views: list[View], weight: float, cost: float):
    """(degree, coefficients [16, 3]) of one Gaussian, by least squares over a list of views."""
    mean, size = gaussians.means[row].double(), float(gaussians.scales[row].max().exp())
    looks = [look(mean, size, view.to(torch.float64)) for view in views]
    total = sum(count for _, count in looks)
    A = np.array([math.sqrt(count / total) * basis for basis, count in looks])
    c = torch.cat((gaussians.features_dc[row][None], gaussians.features_rest[row])).double().numpy()
    found = []
    for degree, kept in enumerate(COEFFICIENTS):
        still = math.sqrt(degrees.RIDGE) * np.eye(kept)
        system, target = np.vstack((A[:, :kept], still)), np.vstack((A @ c, still @ c[:kept]))
        fitted = np.zeros_like(c)
        fitted[:kept] = np.linalg.lstsq(system, target, rcond=None)[0]
        square = ((A @ (fitted - c)) ** 2).sum() / 3
        found.append((weight * square + cost * 3 * (kept - 1), degree, fitted))
    return min(found, key=lambda each: each[0])[1:]


@pytest.mark.parametrize(("cost", "count"), [(0.0, 12), (1e-5, 12), (3e-3, 12), (3e-2, 12), (3e-2, 1)])
def test_every_gaussian_gets_what_a_list_of_views_says(cost, count, monkeypatch):
    """Seen from one place, a colour is all that there is."""
    monkeypatch.setattr(degrees, "NUMBER_COST", cost)
    monkeypatch.setattr(degrees, "AT_ONCE", 3 * 16 * 16)  # several parts
    gaussians, views = random_gaussians(20, seed=3, sh_degree=3), ring_of_views(count)
    found = lowered(gaussians, statistics(20), views, gaussians.sh_degree)
    for row in range(20):
        degree, expected = slow(gaussians, row, views, 30.0, cost)
        assert int(found.gone[row]) == 3 - degree
        values = torch.cat((found.features_dc[row][None], found.features_rest[row])).double().numpy()
        np.testing.assert_allclose(values, expected, atol=1e-3)


def test_what_was_not_looked_at_in_every_view_is_not_judged():
    gaussians, growth = random_gaussians(10, sh_degree=2), statistics(10, weight=1e-9)
    growth["passes"][4:] = 11 / 12
    found = lowered(gaussians, growth, ring_of_views(12), gaussians.sh_degree)
    assert found.gone.tolist() == [2.0] * 4 + [0.0] * 6
    assert torch.equal(found.features_rest[4:], gaussians.features_rest[4:])
    assert torch.equal(found.features_dc[4:], gaussians.features_dc[4:])


def test_what_is_gone_does_not_come_back_by_being_looked_at_again():
    gaussians, views = random_gaussians(30, sh_degree=3), ring_of_views(12)
    growth = {**statistics(30, weight=1e6), GONE: torch.arange(30.0) % 4}
    found = lowered(gaussians, growth, views, gaussians.sh_degree)
    assert bool((found.gone >= growth[GONE]).all())


def test_numbers_that_are_none_are_left_to_who_repairs_them():
    gaussians = random_gaussians(4, sh_degree=3)
    gaussians.means[1] = math.nan
    gaussians.features_rest[2, 5] = math.inf
    found = lowered(gaussians, statistics(4, weight=1e-9), ring_of_views(12), gaussians.sh_degree)
    assert found.gone.tolist() == [3.0, 0.0, 0.0, 3.0]
    assert torch.equal(found.features_rest[1], gaussians.features_rest[1])


def test_a_scene_without_harmonics_has_none_to_lose():
    gaussians = random_gaussians(5, sh_degree=0)
    found = lowered(gaussians, statistics(5), ring_of_views(12), gaussians.sh_degree)
    assert torch.equal(found.features_dc, gaussians.features_dc)
    assert found.gone.tolist() == [0.0] * 5
    assert len(lowered(gaussians[:0], statistics(0), ring_of_views(12), gaussians.sh_degree).gone) == 0


@pytest.fixture(scope="module")
def truth() -> Gaussians:
    """Every other one looks alike from everywhere."""
    truth = random_gaussians(120, seed=7, size=0.12, sh_degree=2)
    truth.features_rest[1::2] *= 3.0
    truth.features_rest[::2] = 0.0
    return truth


@pytest.fixture(scope="module")
def photos(truth, views):
    return Photos(truth, views)


@pytest.fixture
def start(truth):
    return replace(truth, features_rest=truth.features_rest + 0.01)


@pytest.mark.parametrize("blocks", [1, 3])
def test_degrees_go_in_the_later_half_and_stay_away(make, photos, blocks):
    coordinator = make(blocks=blocks, steps=120, density=STILL, batch=1)
    whole, gone = 120 * (11 + 27), []
    for _ in steps_of(coordinator, photos):
        if coordinator.run.share < degrees.START:
            assert coordinator.scene.parameters() == whole
        elif coordinator.state.active is not None and GONE in coordinator.visit.block.growth:
            harmonics, adam = coordinator.params["features_rest"], coordinator.optimizers["features_rest"]
            kept = 2 - coordinator.visit.block.growth[GONE]
            moments = adam.state[harmonics]
            for value in (harmonics, moments["exp_avg"], moments["exp_avg_sq"]):
                assert bool((degrees_in_use([value.detach()]) <= kept).all())
            gone.append(float(kept.mean()))
    assert len(gone) > 10
    assert coordinator.scene.parameters() == count_parameters(whole_scene(coordinator).features_rest)
    assert 120 * 14 < coordinator.scene.parameters() < 0.95 * whole
    left = degrees_in_use([whole_scene(coordinator).features_rest])
    assert float(left[1::2].float().mean()) > float(left[::2].float().mean()) + 0.5 or blocks > 1


def test_a_run_that_was_interrupted_keeps_its_degrees(make, photos):
    assert_resumes(make, photos, 80, blocks=3, steps=100, density=STILL, batch=1)


def test_a_visit_that_draws_each_view_once_is_enough_to_judge_by(make, photos, truth):
    coordinator = make(start=truth, blocks=1, steps=20, density=STILL, batch=1)
    block = coordinator.visit.block
    while coordinator.run.share < degrees.START:
        train_step(coordinator, photos)
    block.growth = {**block.growth, **statistics(len(block))}
    assert block.growth["passes"].tolist() == [1.0] * len(block)
    block.prune()
    assert float(block.growth[GONE].max()) > 0
    assert block.growth["passes"].tolist() == [0.5] * len(block)
