"""Another frame of coordinates: nothing looks different."""

import math
from dataclasses import replace

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from abcd_ns.engine.gaussians.frames import Frame
from abcd_ns.engine.render import TorchRasterizer
from tests.reference.scenes import random_gaussians, ring_of_views

numbers = st.integers(0, 2**31)


def random_frame(seed: int) -> Frame:
    generator = np.random.RandomState(seed)
    turn = torch.from_numpy(Rotation.random(random_state=generator).as_matrix())
    return Frame(turn, torch.from_numpy(generator.normal(size=3)), math.exp(generator.normal()))


@given(numbers)
def test_a_moved_scene_looks_the_same_to_a_camera_that_moves_along(seed):
    frame = random_frame(seed)
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
    assert torch.allclose(after.color, before.color, atol=1e-9)
    assert torch.allclose(after.transmittance, before.transmittance, atol=1e-9)
