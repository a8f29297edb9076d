"""What a split is worth is what it removes of the squared error, on views that did not choose it."""

from dataclasses import replace

import pytest
import torch
from gsplat.utils import normalized_quat_to_rotmat

from abcd_ns.engine.render import Shot, TorchRasterizer
from abcd_ns.engine.train.density.growing import APART, NARROWED
from abcd_ns.engine.train.density.worth import WORTH, Judged, add_picture, half_of, share_seen, worth
from abcd_ns.engine.types import Gaussians
from tests.reference.scenes import random_gaussians, ring_of_views

VIEWS = ring_of_views(12, width=64, height=48)
DRAW = TorchRasterizer()


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
    turned = normalized_quat_to_rotmat(torch.nn.functional.normalize(gaussians.quats, dim=1))
    along = turned[:, :, axis] * gaussians.scales.exp()[:, axis : axis + 1]
    scales = gaussians.scales.clone()
    scales[:, axis] += torch.tensor(NARROWED).log()
    light = torch.tensor([[1.0], [-1.0]]).expand(2, 3) * difference
    both = Gaussians.cat([gaussians, gaussians])
    means = gaussians.means + APART * torch.cat((along, -along))
    opacities = torch.logit(1 - (1 - torch.sigmoid(both.opacities)) ** (1 / (2 * NARROWED)))
    return replace(both, means=means, scales=scales.repeat(2, 1), features_dc=light, opacities=opacities)


def judged(gaussians: Gaussians, photo_of, draw=DRAW) -> torch.Tensor:
    """Statistics of all views."""
    growth = {}
    for view in VIEWS:
        leaves = Gaussians(**{name: value.clone().requires_grad_() for name, value in gaussians.items()})
        (raster,) = draw.draw(leaves, [Shot(view, view.full)], sh_degree=0, residual_sums=True)
        residual = (photo_of(view) - raster.color).detach()
        raster.info["sums"].ask([torch.cat((residual, torch.ones_like(residual[..., :1])), dim=-1)])
        raster.color.sum().backward()
        error = residual.square().sum(dim=-1).mean()
        add_picture(growth, gaussians, 3, Judged(view, raster.info["sums"].values[0], error))
    return growth[WORTH]


def squared_error(gaussians: Gaussians, photo_of) -> float:
    drawn = ((photo_of(view), DRAW(gaussians, view, sh_degree=0).color) for view in VIEWS)
    return sum(float((photo - color).square().sum()) for photo, color in drawn)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_it_is_the_error_that_halves_of_two_colours_remove(axis):
    gaussians = one(opacity=-2.0)
    truth = two_colours(gaussians, axis, 0.3)

    def photo_of(view):
        return DRAW(truth, view, sh_degree=0).color

    gain, along = worth({WORTH: judged(gaussians, photo_of)}, len(VIEWS), 0.0)
    assert int(along) == axis
    removed = squared_error(two_colours(gaussians, axis, 0.0), photo_of)
    assert 0.5 * removed < float(gain) < 1.5 * removed


def test_what_half_of_the_views_contradict_is_worth_nothing():
    gaussians = one()
    ways = [two_colours(gaussians, 1, way) for way in (0.3, -0.3)]
    found = judged(gaussians, lambda view: DRAW(ways[half_of(view.index)], view, sh_degree=0).color)
    assert float(found[:, 1:24].abs().max()) > 0.01
    assert worth({WORTH: found}, len(VIEWS), 0.0)[0].tolist() == [0.0]


def test_what_fits_is_worth_nothing_and_a_larger_bound_refuses_more():
    gaussians = one()
    fits = judged(gaussians, lambda view: DRAW(gaussians, view, sh_degree=0).color)
    assert float(worth({WORTH: fits}, len(VIEWS), 0.0)[0]) < 1e-6
    truth = two_colours(gaussians, 1, 0.3)
    found = {WORTH: judged(gaussians, lambda view: DRAW(truth, view, sh_degree=0).color)}
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
            monkeypatch.setattr("abcd_ns.engine.train.density.worth.suits", lambda *_: False)
        growth = {}
        for view in VIEWS[:2]:
            add_picture(growth, gaussians, axes, Judged(view, sums, torch.tensor(0.5), share=0.5))
        found.append(growth[WORTH])
    torch.testing.assert_close(*found, rtol=1e-4, atol=1e-5)
    assert not bool(found[0][7, :24].any())
    assert bool(found[0][:, :24].any())
