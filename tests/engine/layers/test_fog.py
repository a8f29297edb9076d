from dataclasses import replace

import pytest
import torch

from abcd_ns.engine.layers.surface import NEARER, fog_in_white
from abcd_ns.engine.render import TorchRasterizer
from abcd_ns.engine.types import Gaussians
from tests.reference.scenes import random_gaussians, ring_of_views

DRAW = TorchRasterizer()
(VIEW,) = ring_of_views(1, width=64, height=48)


def share(gaussians, view):
    return float(DRAW(fog_in_white(gaussians, view), view, sh_degree=0).color.mean())


def test_it_is_the_weight_of_what_lies_before_the_nearest_point():
    scene = random_gaussians(40, seed=1, size=0.2)
    z = scene.means @ VIEW.viewmat[2, :3] + VIEW.viewmat[2, 3]
    nearest = float(z.median()) / NEARER
    fog = scene[z < NEARER * nearest]
    alone = 1 - float(DRAW(fog, VIEW, sh_degree=0).transmittance.mean())  # nothing lies before it
    assert alone > 0.02
    assert share(scene, replace(VIEW, nearest=nearest)) == pytest.approx(alone, abs=1e-5)


def test_a_view_that_knows_no_point_has_none():
    assert share(random_gaussians(40, seed=1, size=0.2), VIEW) == 0.0


def test_what_lies_behind_the_camera_is_not_drawn():
    behind = replace(random_gaussians(5, seed=2), means=(VIEW.center - VIEW.viewmat[2, :3]).expand(5, 3))
    assert share(Gaussians.cat([behind]), replace(VIEW, nearest=1.0)) == 0.0
    assert torch.equal(fog_in_white(behind, VIEW).means, behind.means)
