"""Blocks as they are kept: nothing is lost, and zeros beyond a Gaussian's degree take no room."""

from dataclasses import replace

import pytest
import torch

from abcd_ns.engine.gaussians.block_state import BlockState
from abcd_ns.engine.gaussians.packed import DEGREES, DRAWN
from abcd_ns.engine.gaussians.spherical_harmonics import count_parameters
from abcd_ns.engine.types import PARAM_NAMES, Gaussians
from tests.reference.scenes import random_gaussians

COEFFICIENTS = (0, 3, 8, 15)
"""Of degrees 1 and up, by the highest degree."""


def of_degrees(degrees: list[int], highest: int = 3, seed: int = 0) -> BlockState:
    """Trained Gaussians, of which each has harmonics and moments up to its degree."""

    def cut(gaussians: Gaussians) -> Gaussians:
        rest = gaussians.features_rest.clone()
        for row, degree in enumerate(degrees):
            rest[row, COEFFICIENTS[degree] :] = 0.0
        return replace(gaussians, features_rest=rest)

    parts = [cut(random_gaussians(len(degrees), seed + k, sh_degree=highest)) for k in range(3)]
    return BlockState(*parts, {"weight": torch.rand(len(degrees))})


def assert_same(a: BlockState, b: BlockState) -> None:
    for part in ("gaussians", "exp_avg", "exp_avg_sq"):
        for name in PARAM_NAMES:
            ours, theirs = (getattr(getattr(state, part), name) for state in (a, b))
            assert torch.equal(ours.nan_to_num(7.5), theirs.nan_to_num(7.5)), (part, name)
    assert torch.equal(a.growth["weight"], b.growth["weight"])
    assert torch.equal(a.deferred, b.deferred)
    assert a.clocks == b.clocks


@pytest.mark.parametrize("highest", [0, 1, 2, 3])
@pytest.mark.parametrize("count", [0, 1, 13])
def test_every_value_comes_back(highest, count):
    state = of_degrees([row % (highest + 1) for row in range(count)], highest)
    assert_same(BlockState.unpacked(state.packed()), state)


def test_a_moment_where_the_value_is_zero_comes_back():
    state = of_degrees([0, 1, 2])
    state.exp_avg_sq.features_rest[0, 14, 2] = 1e-30
    state.gaussians.features_rest[1, 7, 0] = float("nan")
    back = BlockState.unpacked(state.packed())
    assert_same(back, state)
    assert state.packed().tensors[DEGREES].tolist() == [3, 2, 2]
    assert bool(back.gaussians.features_rest[1, 7, 0].isnan())


def test_what_is_kept_is_as_much_as_the_degrees_ask_for():
    degrees = [0, 0, 1, 3, 2, 0]
    state = of_degrees(degrees)
    packed = state.packed()
    coefficients = sum(COEFFICIENTS[degree] for degree in degrees)
    for name in ("features_rest", "exp_avg.features_rest", "exp_avg_sq.features_rest"):
        assert packed.tensors[name].shape == (coefficients, 3)
    assert packed.tensors[DEGREES].tolist() == degrees
    # Two moments beside each number; a statistic, a degree, and whether it waits.
    assert packed.nbytes == 3 * 4 * (14 * len(degrees) + 3 * coefficients) + (4 + 1 + 1) * len(degrees)
    assert packed.meta["parameters"] == 14 * len(degrees) + 3 * coefficients
    assert count_parameters(state.gaussians.features_rest) == packed.meta["parameters"]


def test_some_rows_of_what_is_drawn_are_those_of_all():
    state = of_degrees([3, 0, 2, 1, 0, 3])
    rows = torch.tensor([True, False, True, False, True, False])
    chosen = state.packed().drawn_at(rows)
    assert chosen.tensors.keys() == set(DRAWN)
    assert all(
        torch.equal(value, getattr(state.gaussians[rows], name)) for name, value in chosen.gaussians().items()
    )
