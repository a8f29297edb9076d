"""Another frame of coordinates: nothing looks different."""

import math
from dataclasses import replace

import numpy as np
import torch
from hypothesis import given
from scipy.spatial.transform import Rotation

from abcd_ns.engine.gaussians.similarity import Similarity
from abcd_ns.engine.render import TorchRasterizer
from tests.engine.space.test_tree import SEEDS
from tests.reference.rasterizer_scenes import assert_same_layer
from tests.reference.scenes import random_gaussians, ring_of_views


@given(SEEDS)
def test_a_moved_scene_looks_the_same_to_a_camera_that_moves_along(seed):
    generator = np.random.RandomState(seed)
    turn = torch.from_numpy(Rotation.random(random_state=generator).as_matrix())
    frame = Similarity(turn, torch.from_numpy(generator.normal(size=3)), math.exp(generator.normal()))
    # The blur of 0.3 pixels does not depend on units, nor does anything else that is drawn.
    gaussians = random_gaussians(40, seed, sh_degree=3, dtype=torch.float64)
    (view,) = ring_of_views(1, dtype=torch.float64)
    moved = view.viewmat.clone()
    moved[:3, :3] = view.viewmat[:3, :3] @ frame.rotation.T
    moved[:3, 3] = frame.scale * (view.viewmat[:3, 3] - moved[:3, :3] @ frame.translation)
    draw = TorchRasterizer(use_native=False)
    before = draw(gaussians, view, sh_degree=3)
    after = draw(frame.gaussians(gaussians), replace(view, viewmat=moved), sh_degree=3)
    assert float(before.color.max()) > 0.05
    assert_same_layer(after, before, atol=1e-9)
