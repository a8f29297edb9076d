"""Blocks with all that belongs to them: parted and joined, packed without loss, swapped into Adam."""

import copy
from dataclasses import replace

import pytest
import torch

from abcd_ns.engine.gaussians.block_state import DEGREES, DRAWN, BlockState, Clocks, join
from abcd_ns.engine.gaussians.param_swap import active_gaussians, attach, detach, nothing_active
from abcd_ns.engine.gaussians.spherical_harmonics import count_parameters
from abcd_ns.engine.types import PARAM_NAMES, Gaussians
from tests.reference.scenes import activated, assert_same_state, equal, random_gaussians

COEFFICIENTS = (0, 3, 8, 15)
"""Of degrees 1 and up, by the highest degree."""


def some_state(count: int, seed: int = 0) -> BlockState:
    generator = torch.Generator().manual_seed(seed)
    return BlockState(
        random_gaussians(count, seed),
        random_gaussians(count, seed + 1),
        Gaussians(**{n: v**2 for n, v in random_gaussians(count, seed + 2).items()}),
        {"worth": torch.rand(count, generator=generator), "count": torch.rand(count, generator=generator)},
        Clocks(steps=7, adam_views=5, visits=2),
    )


def take_step(params, optimizers) -> None:
    sum((p**2).sum() for p in params.values()).backward()
    for optimizer in optimizers.values():
        optimizer.step()


def test_rows_that_part_and_join_again_lose_nothing():
    state = some_state(10)
    mask = torch.arange(10) % 3 == 0
    rows = torch.cat([torch.where(mask)[0], torch.where(~mask)[0]])
    assert_same_state(join([state[mask], state[~mask]]), state[rows])


def test_a_statistic_that_one_side_lacks_starts_at_zero():
    joined = join([BlockState.fresh(random_gaussians(2)), some_state(3)])
    assert joined.growth["worth"][:2].tolist() == [0, 0]
    assert torch.equal(joined.growth["worth"][2:], some_state(3).growth["worth"])


def test_tensors_of_unequal_length_are_refused():
    with pytest.raises(ValueError, match="equally many rows"):
        BlockState(random_gaussians(3), random_gaussians(2), random_gaussians(3))


def test_the_block_before_frees_its_memory_whoever_still_refers_to_it():
    params, optimizers = activated(random_gaussians(6))
    kept = copy.copy(params)
    take_step(params, optimizers)
    attach(some_state(3, seed=5), params, optimizers)
    assert all(kept[name].numel() == 0 and kept[name].grad is None for name in PARAM_NAMES)
    assert all(len(optimizers[name].state) == 1 for name in PARAM_NAMES)


def test_detached_tensors_do_not_follow_later_steps():
    state, (params, optimizers) = some_state(6), nothing_active(1)
    attach(state, params, optimizers)
    stored = detach(params, optimizers, state.growth, state.clocks)
    take_step(params, optimizers)
    assert_same_state(stored, state)
    assert not torch.equal(active_gaussians(params).means, stored.gaussians.means)


def of_degrees(degrees: list[int], highest: int = 3, seed: int = 0) -> BlockState:
    """Trained Gaussians, of which each has harmonics and moments up to its degree."""

    def cut(gaussians: Gaussians) -> Gaussians:
        rest = gaussians.features_rest.clone()
        for row, degree in enumerate(degrees):
            rest[row, COEFFICIENTS[degree] :] = 0.0
        return replace(gaussians, features_rest=rest)

    parts = [cut(random_gaussians(len(degrees), seed + k, sh_degree=highest)) for k in range(3)]
    return BlockState(*parts, {"weight": torch.rand(len(degrees))})


@pytest.mark.parametrize("highest", [0, 1, 2, 3])
@pytest.mark.parametrize("count", [0, 1, 13])
def test_every_value_comes_back(highest, count):
    state = of_degrees([row % (highest + 1) for row in range(count)], highest)
    assert_same_state(BlockState.unpacked(state.packed()), state)


def test_a_moment_where_the_value_is_zero_comes_back():
    state = of_degrees([0, 1, 2])
    state.exp_avg_sq.features_rest[0, 14, 2] = 1e-30
    state.gaussians.features_rest[1, 7, 0] = float("nan")
    back = BlockState.unpacked(state.packed())
    assert_same_state(back, state)
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
    assert equal(chosen.gaussians(), state.gaussians[rows])
