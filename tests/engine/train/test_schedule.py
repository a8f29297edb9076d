"""The schedule is pure integers, so it is tested over whole ranges."""

from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from abcd_ns.engine.train.schedule import (
    SHORTER,
    UNDER_TRAINED,
    final_decay,
    passes_of_visit,
    plan_epoch,
    sh_degree_at,
    view_order,
    views_per_step,
    views_per_visit,
    visit_views,
)

VIEWS = st.dictionaries(st.integers(0, 30), st.integers(0, 200), min_size=1, max_size=12)


@given(views=VIEWS, passes=st.integers(1, 6), epoch=st.integers(0, 50), seed=st.integers(0, 5))
def test_an_epoch_visits_every_seen_block_once_in_proportion_to_its_views(views, passes, epoch, seed):
    plans = sorted((plan.block, plan.steps) for plan in plan_epoch(epoch, views, passes, seed))
    assert plans == sorted((block, passes * n) for block, n in views.items() if n > 0)


@given(views=VIEWS, passes=st.integers(1, 6), batches=st.dictionaries(st.integers(0, 30), st.integers(1, 4)))
def test_a_visit_uses_its_views_as_often_whatever_a_step_draws(views, passes, batches):
    for plan in plan_epoch(0, views, passes, 0, batches=batches):
        batch, uses = batches.get(plan.block, 1), passes * views[plan.block]
        assert uses <= plan.steps * batch < uses + batch


@pytest.mark.parametrize(
    ("trained", "draws"), [(UNDER_TRAINED - 1, 1), (UNDER_TRAINED, 2), (2 * UNDER_TRAINED, 4), (None, 4)]
)
def test_the_steps_of_an_under_trained_block_draw_fewer_views(trained, draws):
    assert views_per_step(0, 8, trained=trained) == draws
    assert views_per_step(3, 8, trained=trained) == 3  # as is asked for
    assert views_per_step(0, 1, trained=trained) == 1


@given(count=st.integers(1, 20), steps=st.integers(0, 100), visit=st.integers(0, 9))
def test_views_are_used_evenly_in_an_order_of_the_visits_own(count, steps, visit):
    views = tuple(range(count))
    order = view_order(views, steps, visit, seed=1)
    uses = [order.count(view) for view in views]
    assert sum(uses) == len(order) == steps
    assert max(uses) - min(uses) <= 1
    assert order == view_order(views, steps, visit, seed=1)
    views = tuple(range(20))
    assert len({view_order(views, 20, visit, seed) for visit in range(3) for seed in range(3)}) == 9


def test_a_visit_is_about_as_long_with_many_views_as_with_few():
    assert [passes_of_visit(8, used, 1, 8) for used in (1, 32, 44, 64)] == [8, 8, 6, 4]


@given(passes=st.integers(1, 60), at_once=st.integers(1, 40), blocks=st.integers(1, 30))
def test_visits_are_the_shorter_the_more_are_out_at_once(passes, at_once, blocks):
    found, longest = (passes_of_visit(passes, 20, n, blocks) for n in (at_once, 1))
    assert longest == passes
    assert passes / SHORTER <= passes_of_visit(passes, 20, at_once + 1, blocks) <= found <= passes
    assert blocks == 1 or passes_of_visit(passes, 20, blocks, blocks) == passes / SHORTER


def test_rates_of_one_block_fall_at_the_end_of_the_run():
    # The last is of a budget of seconds that was overdrawn.
    found = [final_decay(progress, 5000) for progress in (0.0, 0.6, 0.8, 1.0, 3.0)]
    assert found == pytest.approx([1.0, 1.0, 10**-0.5, 0.1, 0.1])
    assert final_decay(1.0, 100) == pytest.approx(10**-0.1)  # it saw few views


def test_degree_of_30000_steps_is_splatfactos():
    degrees = [sh_degree_at(step / 30_000, 0.1, 3) for step in range(30_000)]
    assert degrees == [min(step // 1000, 3) for step in range(30_000)]
    assert sh_degree_at(0.0, 0.0, 3) == 3


@given(seen=st.integers(0, 5000), typical=st.integers(1, 400), limit=st.integers(1, 64))
def test_every_block_uses_the_same_share_of_its_views(seen, typical, limit):
    used = views_per_visit(seen, typical, limit)
    assert (used == 0) == (seen == 0)
    assert used <= min(seen, 2 * limit)
    assert abs(used - min(seen * min(1, limit / typical), 2 * limit)) < 1
    assert views_per_visit(typical, typical, limit) == min(typical, limit)


@given(count=st.integers(1, 30), data=st.data())
def test_visits_use_all_views_of_a_block_in_turn(count, data):
    used = data.draw(st.integers(1, count))
    views = tuple(range(100, 100 + count))
    uses = Counter()
    for visits in range(3 * count):
        chosen = visit_views(views, used, visits, seed=2)
        assert set(chosen) <= set(views)
        assert 1 <= len(chosen) <= used
        uses.update(chosen)
    # 3 count visits pass through the views 3 used times; a view that a visit meets twice is used once.
    assert max(uses.values()) <= 3 * used
    assert min(uses.values()) >= 2 * used
