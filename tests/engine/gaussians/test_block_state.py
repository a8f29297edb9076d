"""Stored blocks, and swapping them into active parameters and Adam."""

import copy

import pytest
import torch

from abcd_ns.engine.gaussians.block_state import BlockState, Clocks, join
from abcd_ns.engine.gaussians.param_swap import active_gaussians, attach, detach, nothing_active
from abcd_ns.engine.types import PARAM_NAMES, Gaussians
from tests.reference.scenes import random_gaussians


def some_state(count: int, seed: int = 0) -> BlockState:
    generator = torch.Generator().manual_seed(seed)
    return BlockState(
        random_gaussians(count, seed),
        random_gaussians(count, seed + 1),
        Gaussians(**{n: v**2 for n, v in random_gaussians(count, seed + 2).items()}),
        {"worth": torch.rand(count, generator=generator), "count": torch.rand(count, generator=generator)},
        Clocks(steps=7, adam_views=5, visits=2),
    )


def assert_same(a: BlockState, b: BlockState) -> None:
    ours, theirs = a.packed(), b.packed()
    assert ours[0].keys() == theirs[0].keys()
    assert ours[1] == theirs[1]
    for name, value in ours[0].items():
        assert torch.equal(value, theirs[0][name]), name


def active(state: BlockState):
    params, optimizers = nothing_active(1)
    attach(state, params, optimizers)
    return params, optimizers


def take_steps(params, optimizers, count: int) -> None:
    for _ in range(count):
        loss = sum((p**2).sum() for p in params.values())
        for optimizer in optimizers.values():
            optimizer.zero_grad()
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()


def test_rows_that_part_and_join_again_lose_nothing():
    state = some_state(10)
    mask = torch.arange(10) % 3 == 0
    rows = torch.cat([torch.where(mask)[0], torch.where(~mask)[0]])
    assert_same(join([state[mask], state[~mask]]), state[rows])


def test_a_statistic_that_one_side_lacks_starts_at_zero():
    joined = join([BlockState.fresh(random_gaussians(2)), some_state(3)])
    assert joined.growth["worth"][:2].tolist() == [0, 0]
    assert torch.equal(joined.growth["worth"][2:], some_state(3).growth["worth"])


def test_tensors_of_unequal_length_are_refused():
    with pytest.raises(ValueError, match="equally many rows"):
        BlockState(random_gaussians(3), random_gaussians(2), random_gaussians(3))


def test_the_block_before_frees_its_memory_whoever_still_refers_to_it():
    params, optimizers = active(some_state(6))
    kept = copy.copy(params)
    take_steps(params, optimizers, 1)
    attach(some_state(3, seed=5), params, optimizers)
    assert all(kept[name].numel() == 0 and kept[name].grad is None for name in PARAM_NAMES)
    assert all(len(optimizers[name].state) == 1 for name in PARAM_NAMES)


def test_detached_tensors_do_not_follow_later_steps():
    state = some_state(6)
    params, optimizers = active(state)
    stored = detach(params, optimizers, state.growth, state.clocks)
    take_steps(params, optimizers, 1)
    assert_same(stored, state)
    assert not torch.equal(active_gaussians(params).means, stored.gaussians.means)
