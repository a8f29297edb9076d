"""Learning rates of steps of several views."""

from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from abcd_ns.engine.gaussians.block_state import MOMENTS, BlockState, Clocks
from abcd_ns.engine.gaussians.param_swap import LATE_RATE, Pace, adam_step, attach, detach, nothing_active
from abcd_ns.engine.types import PARAM_NAMES
from tests.reference.scenes import activated, random_gaussians


def travelled(views: int, steps: int) -> dict[str, float]:
    """How far each parameter comes where all views ask for the same."""
    before = random_gaussians(1)
    params, adam = activated(before)
    pace = Pace(adam, fast_start=False)
    for _ in range(steps):
        pace.set(views, 0, means_decay=1.0)
        for name in PARAM_NAMES:
            params[name].grad = torch.ones_like(params[name])
            adam[name].step()
    return {name: float((params[name].detach() - value).abs().max()) for name, value in before.items()}


@given(views=st.integers(1, 16))
def test_views_that_agree_come_as_far_together_as_one_by_one(views):
    together, one_by_one = travelled(views, steps=1), travelled(1, steps=views)
    assert together == pytest.approx(one_by_one, rel=1e-2)


@pytest.mark.parametrize("late", [False, True])
@pytest.mark.parametrize(
    ("views", "batch", "times"), [(0, 2, 4), (2_500, 1, 2), (2_000, 4, 4), (10_000, 1, 1)]
)
def test_a_block_that_has_had_few_steps_takes_larger_ones(views, batch, times, late):
    """And harmonics that come late larger ones still."""
    _, adam = nothing_active(sh_degree=0)
    given = {name: adam[name].param_groups[0]["lr"] for name in PARAM_NAMES}
    Pace(adam, fast_start=True, late=late).set(batch, views, means_decay=0.5)
    shares = {"means": 0.5, "features_rest": LATE_RATE if late else 1.0}
    expected = {name: times * rate * shares.get(name, 1.0) for name, rate in given.items()}
    assert {name: adam[name].param_groups[0]["lr"] for name in PARAM_NAMES} == pytest.approx(expected)


@pytest.mark.parametrize(
    ("batches", "rel"),
    [
        ([(1, 3), (2, 2), (4, 2)], 1e-4),
        ([(2, 5), (4, 3), (1, 2)], 1e-4),
        ([(4, 1)] * 5, 1e-4),
        ([(1, 4), (3, 4), (5, 3), (7, 2)], 2e-3),  # nearly so where batches do not divide each other
    ],
)
def test_moments_are_read_with_the_decay_that_they_had(batches, rel):
    """A gradient of 1 is found to be 1 at every step, whatever the views of the steps before.

    Args:
        batches: (views in a step, steps); the block is taken out and put back in between.
    """
    params, optimizers = nothing_active(sh_degree=0)
    pace, stored = Pace(optimizers, fast_start=False), BlockState.fresh(random_gaussians(2))
    for batch, steps in batches:
        attach(stored, params, optimizers, batch=batch)
        parameter, adam, clocks = params["scales"], optimizers["scales"], stored.clocks
        for _ in range(steps):
            pace.set(batch, 0, means_decay=1.0)
            parameter.grad = torch.ones_like(parameter)
            adam.step()
            clocks = replace(clocks, adam_views=clocks.adam_views + batch)
            state = adam.state[parameter]
            for name, beta in zip(MOMENTS, adam.param_groups[0]["betas"], strict=True):
                corrected = float(state[name].mean()) / (1 - beta ** float(state["step"]))
                assert corrected == pytest.approx(1, rel=rel)
        stored = detach(params, optimizers, {}, clocks)


@given(begun=st.integers(0, 4000), batch=st.integers(1, 9), taken=st.integers(0, 500))
def test_a_block_that_is_put_back_goes_on_with_the_very_same_count(begun, batch, taken):
    stepped = adam_step(Clocks(adam_views=begun), batch)
    for _ in range(taken):
        stepped += 1
    assert torch.equal(adam_step(Clocks(adam_views=begun + batch * taken), batch), stepped)
