"""Budgets in views drawn, by which methods are compared."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.train.schedule import COARSE_MODEL_PASSES, views_per_step
from abcd_ns.lab.stability.lab import Lab, make_stage, steps_for


@given(
    drawn=st.integers(100, 10_000),
    views=st.integers(1, 50),
    waiting=st.sampled_from([0, 5]),
    blocks=st.sampled_from([1, 8]),
)
def test_the_steps_of_a_budget_draw_as_many_views(drawn, views, waiting, blocks):
    config = TrainingConfig(warmup=0.2, batch=0)
    steps = steps_for(drawn, config, blocks, views, waiting)
    least = 0.0 if blocks == 1 else 0.2 * steps
    enough = COARSE_MODEL_PASSES * views
    warm = math.ceil(min(enough, least) if waiting else min(max(enough, least), 2 * least))
    trained, found = [warm] * blocks, warm
    for step in range(steps - warm):  # a block after the other
        batch = views_per_step(0, blocks, trained=trained[step % blocks])
        trained[step % blocks] += batch
        found += batch
    assert found == pytest.approx(drawn, abs=3 * views_per_step(0, blocks))


def test_a_labs_seed_is_that_of_its_trainings_unless_they_name_one(tmp_path):
    stage = make_stage()
    lab = Lab(tmp_path, seed=3)
    assert lab.coordinator(stage.start(), stage.views, budget=100).config.seed == 3
    assert lab.coordinator(stage.start(), stage.views, budget=100, seed=5).config.seed == 5
