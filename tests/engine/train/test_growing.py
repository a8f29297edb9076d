"""One Gaussian becomes two that look as it did, where that is worth it: in views that did not choose it."""

from dataclasses import replace

import pytest
import torch
from gsplat.utils import normalized_quat_to_rotmat
from hypothesis import given
from hypothesis import strategies as st

from abcd_ns.engine.gaussians.param_swap import active_gaussians
from abcd_ns.engine.render import TorchRasterizer
from abcd_ns.engine.train.density.growing import (
    WORTH,
    Judged,
    add_picture,
    chosen,
    half_of,
    share_seen,
    split_gaussians,
    worth,
)
from abcd_ns.engine.types import PARAM_NAMES, Gaussians
from tests.engine.space.test_tree import SEEDS
from tests.reference.rasterizer_scenes import as_leaves, drawn
from tests.reference.scenes import activated, random_gaussians, ring_of_views

VIEWS = ring_of_views(12, width=64, height=48)
DRAW = TorchRasterizer()


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


# What a split is worth


def one(opacity: float = 0.0) -> Gaussians:
    """In the middle, three times as long along its second axis; grey."""
    gaussians = random_gaussians(1, sh_degree=0)
    return replace(
        gaussians,
        means=torch.tensor([[0.1, -0.1, 0.05]]),
        scales=torch.tensor([[0.1, 0.3, 0.1]]).log(),
        features_dc=torch.zeros(1, 3),
        opacities=torch.full((1, 1), opacity),
    )


def two_colours(gaussians: Gaussians, axis: int, difference: float) -> Gaussians:
    """The halves that it would become along an axis, the one lighter and the other darker."""
    both, _ = after_split(gaussians, [True], torch.tensor([axis]))
    return replace(both, features_dc=torch.tensor([[1.0], [-1.0]]).expand(2, 3) * difference)


def judged(gaussians: Gaussians, *truths: Gaussians) -> torch.Tensor:
    """Statistics of all views. Photos are of a truth, or of one for each half of the views."""
    growth = {}
    for view in VIEWS:
        raster = drawn(DRAW, as_leaves(gaussians), view, sh_degree=0, residual_sums=True)
        photo = DRAW(truths[half_of(view.index) % len(truths)], view, sh_degree=0).color
        residual = (photo - raster.color).detach()
        raster.info["sums"].ask([torch.cat((residual, torch.ones_like(residual[..., :1])), dim=-1)])
        raster.color.sum().backward()
        error = residual.square().sum(dim=-1).mean()
        add_picture(growth, gaussians, 3, Judged(view, raster.info["sums"].values[0], error))
    return growth[WORTH]


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_it_is_the_error_that_halves_of_two_colours_remove(axis):
    gaussians = one(opacity=-2.0)
    truth = two_colours(gaussians, axis, 0.3)
    gain, along = worth({WORTH: judged(gaussians, truth)}, len(VIEWS), 0.0)
    assert int(along) == axis
    parts, removed = two_colours(gaussians, axis, 0.0), 0.0
    for view in VIEWS:
        pictures = (DRAW(drawn, view, sh_degree=0).color for drawn in (truth, parts))
        removed += float((next(pictures) - next(pictures)).square().sum())
    assert 0.5 * removed < float(gain) < 1.5 * removed


def test_what_half_of_the_views_contradict_is_worth_nothing():
    gaussians = one()
    found = judged(gaussians, *(two_colours(gaussians, 1, way) for way in (0.3, -0.3)))
    assert float(found[:, 1:24].abs().max()) > 0.01
    assert worth({WORTH: found}, len(VIEWS), 0.0)[0].tolist() == [0.0]


def test_what_fits_is_worth_nothing_and_a_larger_bound_refuses_more():
    gaussians = one()
    assert float(worth({WORTH: judged(gaussians, gaussians)}, len(VIEWS), 0.0)[0]) < 1e-6
    found = {WORTH: judged(gaussians, two_colours(gaussians, 1, 0.3))}
    gain, pixel = float(worth(found, len(VIEWS), 0.0)[0]), float(found[WORTH][0, -2]) / len(VIEWS)
    assert float(worth(found, len(VIEWS), 0.9 * gain / pixel)[0]) == pytest.approx(gain)
    assert float(worth(found, len(VIEWS), 1.1 * gain / pixel)[0]) == 0.0


def test_what_is_no_number_counts_for_nothing():
    sums = torch.ones(4, 10)
    sums[1, 4], sums[2, 0] = torch.nan, 0.0
    add_picture(growth := {}, random_gaussians(4), 2, Judged(VIEWS[0], sums, torch.tensor(torch.inf)))
    found = growth[WORTH]
    assert bool(found.isfinite().all())
    assert share_seen(growth) == 0.75
    assert found[1:3, :24].abs().max() == 0
    assert found[0, :24].abs().max() > 0
    assert found[:, 6:9].abs().max() == found[:, 11].abs().max() == 0  # surfels have two axes


@pytest.mark.parametrize("axes", [2, 3])
def test_the_native_library_finds_the_same(monkeypatch, axes):
    gaussians = random_gaussians(200, size=0.3)
    sums = torch.randn(200, 10, generator=torch.Generator().manual_seed(1))
    sums[:, 0] = sums[:, 0].clamp_min(0)  # some have no weight
    sums[7, 4] = torch.nan
    found = []
    for native in (True, False):
        if not native:
            monkeypatch.setattr("abcd_ns.engine.train.density.growing.suits", lambda *_: False)
        growth = {}
        for view in VIEWS[:2]:
            add_picture(growth, gaussians, axes, Judged(view, sums, torch.tensor(0.5), share=0.5))
        found.append(growth[WORTH])
    torch.testing.assert_close(*found, rtol=1e-4, atol=1e-5)
    assert not bool(found[0][7, :24].any())
    assert bool(found[0][:, :24].any())
