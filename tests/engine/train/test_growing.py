"""One Gaussian becomes two that look as it did, as nearly as two can."""

import pytest
import torch
from gsplat.utils import normalized_quat_to_rotmat
from hypothesis import given
from hypothesis import strategies as st

from abcd_ns.engine.gaussians.param_swap import active_gaussians
from abcd_ns.engine.train.density.growing import chosen, split_gaussians
from abcd_ns.engine.types import PARAM_NAMES, Gaussians
from tests.engine.space.test_tree import SEEDS
from tests.reference.scenes import activated, random_gaussians


def after_split(gaussians: Gaussians, which, axis=None, growth=None):
    """The Gaussians afterwards, and their statistics."""
    params, optimizers = activated(gaussians)
    axis = gaussians.scales.argmax(dim=1) if axis is None else axis
    found = split_gaussians(params, optimizers, growth or {}, torch.as_tensor(which), axis)
    for name in PARAM_NAMES:
        (held,) = optimizers[name].param_groups[0]["params"]
        assert held is params[name]
        assert len(optimizers[name].state[held]["exp_avg"]) == len(held)
    return active_gaussians(params).detach(), found


def covariance(gaussians: Gaussians):
    turned = normalized_quat_to_rotmat(torch.nn.functional.normalize(gaussians.quats, dim=1))
    axes = turned * gaussians.scales.exp()[:, None]
    return axes @ axes.transpose(1, 2)


def optical_depth(gaussians: Gaussians):
    """-log(1 - opacity), integrated over space but for a constant."""
    return -torch.log1p(-torch.sigmoid(gaussians.opacities[:, 0])) * gaussians.scales.exp().prod(dim=1)


@given(SEEDS, st.integers(1, 9))
def test_two_have_the_optical_depth_the_middle_and_the_variance_of_the_one(seed, count):
    before = random_gaussians(count, seed=seed)
    after, _ = after_split(before, [True] * count)
    first, second = after[:count], after[count:]
    assert torch.allclose(optical_depth(first) + optical_depth(second), optical_depth(before), rtol=1e-4)
    assert torch.allclose((first.means + second.means) / 2, before.means, atol=1e-6)
    apart = (first.means - second.means) / 2
    both = covariance(first) + apart[:, :, None] * apart[:, None]
    assert torch.allclose(both, covariance(before), rtol=1e-3, atol=1e-6)
    for name in ("quats", "features_dc", "features_rest"):
        assert torch.equal(getattr(first, name), getattr(before, name))


@given(SEEDS)
def test_they_lie_along_the_axis_that_is_asked_for(seed):
    before, axis = random_gaussians(6, seed=seed), torch.tensor([0, 1, 2, 0, 1, 2])
    after, _ = after_split(before, [True] * 6, axis)
    turned = normalized_quat_to_rotmat(torch.nn.functional.normalize(before.quats, dim=1))
    apart = torch.nn.functional.normalize(after.means[:6] - before.means, dim=1)
    along = turned[torch.arange(6), :, axis]
    assert torch.allclose((apart * along).sum(dim=1), torch.ones(6), atol=1e-4)
    others = torch.arange(3) != axis[:, None]
    assert torch.equal(after.scales[:6][others], before.scales[others])


def test_the_others_and_their_statistics_stay_and_the_halves_inherit():
    before = random_gaussians(5, seed=2)
    growth = {"weight": torch.arange(5.0), "passes": torch.arange(5.0)}
    after, found = after_split(before, [False, True, False, True, False], growth=growth)
    for name in PARAM_NAMES:
        assert torch.equal(getattr(after, name)[:3], getattr(before, name)[[0, 2, 4]])
    assert found["weight"].tolist() == [0, 2, 4, 0.5, 1.5, 0.5, 1.5]
    assert found["passes"].tolist() == [0, 2, 4, 1, 3, 1, 3]
    assert growth["weight"].tolist() == [0, 1, 2, 3, 4]


def test_the_opaque_stay_opaque():
    before = random_gaussians(3)
    before.opacities[:] = torch.tensor([[30.0], [6.0], [0.0]])
    after, _ = after_split(before, [True] * 3)
    shown = torch.sigmoid(after.opacities[:3, 0])
    assert bool(after.opacities.isfinite().all())
    assert bool((shown[:2] > 0.99).all())
    assert float(shown[2]) == pytest.approx(1 - 0.5 ** (1 / 1.2))


@pytest.mark.parametrize(("room", "expected"), [(9, [1, 2, 3, 4]), (2, [2, 4]), (1, [4]), (0, []), (-3, [])])
def test_those_grow_that_want_to_most(room, expected):
    wanted = torch.tensor([0.0, 1.0, 3.0, 2.0, torch.inf, 0.0])
    assert chosen(wanted, room).nonzero().flatten().tolist() == expected
