"""Learning rates of steps of several views."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from abcd_ns.engine.block_state import BlockState
from abcd_ns.engine.param_swap import Pace, attach, nothing_live
from abcd_ns.engine.types import PARAM_NAMES
from tests.reference.scenes import random_gaussians


def travelled(power: float, views: int, steps: int) -> dict[str, float]:
    """How far each parameter comes where all views ask for the same."""
    params, adam = nothing_live(sh_degree=1)
    attach(BlockState.fresh(random_gaussians(1)), params, adam)
    pace, before = Pace(adam, power), {name: params[name].detach().clone() for name in PARAM_NAMES}
    for _ in range(steps):
        pace.set(views, means_decay=1.0)
        for name in PARAM_NAMES:
            params[name].grad = torch.ones_like(params[name])
            adam[name].step()
    return {name: float((params[name].detach() - before[name]).abs().max()) for name in PARAM_NAMES}


@given(views=st.integers(1, 16))
def test_views_that_agree_come_as_far_together_as_one_by_one(views):
    together, one_by_one = travelled(1.0, views, steps=1), travelled(1.0, 1, steps=views)
    assert together == pytest.approx(one_by_one, rel=1e-2)


@given(views=st.integers(1, 16), power=st.sampled_from([0.5, 0.75, 1.0]))
def test_a_step_grows_with_the_power_of_its_views(views, power):
    single = travelled(power, 1, steps=1)
    expected = {name: far * math.pow(views, power) for name, far in single.items()}
    assert travelled(power, views, steps=1) == pytest.approx(expected, rel=1e-2)
