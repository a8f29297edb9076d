"""Budgets in views drawn, by which methods are compared."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.lab.stability.lab import Lab, make_stage, steps_for


@given(
    drawn=st.integers(100, 10_000),
    views=st.integers(1, 50),
    passes=st.integers(1, 20),
    blocks=st.sampled_from([1, 8]),
)
def test_the_steps_of_a_budget_draw_as_many_views(drawn, views, passes, blocks):
    config = TrainingConfig(warmup=0.2, batch=0)
    steps = steps_for(drawn, config, blocks, views, passes)
    batch, share = (1, 0.0) if blocks == 1 else (4, config.warmup)
    warm = min(math.ceil(share * steps), math.ceil(passes * views))
    assert warm + (steps - warm) * batch == pytest.approx(drawn, abs=2 * batch)


def test_a_labs_seed_is_that_of_its_trainings_unless_they_name_one(tmp_path):
    stage = make_stage()
    lab = Lab(tmp_path, compile="never", seed=3)
    assert lab.coordinator(stage.start(), stage.views, budget=100).config.seed == 3
    assert lab.coordinator(stage.start(), stage.views, budget=100, seed=5).config.seed == 5
