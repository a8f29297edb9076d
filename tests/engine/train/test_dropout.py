"""With few photos, steps leave out some Gaussians."""

import pytest
import torch

from abcd_ns.engine.train.step.dropout import dropout_at, thinned
from tests.reference.scenes import random_gaussians


def test_dropout_rises_along_the_run_and_with_uses_and_ends_at_16_photos():
    assert dropout_at(1.0, 4, 100, 0.2) == dropout_at(1.0, 4, 900, 0.2) == pytest.approx(0.15)
    assert dropout_at(0.5, 4, 50, 0.2) == pytest.approx(0.0375)
    assert [dropout_at(share, views, 100, 0.2) for share, views in ((1, 16), (1, 300), (0, 3))] == [0, 0, 0]


def test_the_share_is_left_out_anew_in_each_step_and_the_mean_opacity_stays():
    gaussians = random_gaussians(20_000)
    gaussians.opacities.fill_(-1.0).requires_grad_()
    found = [thinned(gaussians, 0.2, f"{seed}") for seed in range(2)]
    before, *drawn = (torch.sigmoid(each.opacities.detach()) for each in (gaussians, *found))
    gone = [opacity < 1 / 255 for opacity in drawn]
    assert [float(each.float().mean()) for each in gone] == pytest.approx([0.2, 0.2], abs=0.01)
    assert float((gone[0] & gone[1]).float().mean()) == pytest.approx(0.04, abs=0.01)
    assert float(drawn[0].mean()) == pytest.approx(float(before.mean()), rel=0.02)
    assert torch.equal(thinned(gaussians, 0.2, "1").opacities, found[1].opacities)
    found[0].opacities.sum().backward()
    assert torch.equal(gaussians.opacities.grad == 0, gone[0])
    assert thinned(gaussians, 0.0, "1") is gaussians
