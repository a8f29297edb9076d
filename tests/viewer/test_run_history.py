"""What the panel makes of a run's events: states of blocks, the table, the curve, time left."""

import math
from types import SimpleNamespace

import pytest

from abcd_ns.engine.events import StepTaken, VisitBegan, VisitEnded, WorkerSeen
from abcd_ns.engine.layers.footprints import VisitGeometry
from abcd_ns.engine.store.special_blocks import WHOLE
from abcd_ns.engine.train.health_record import BlockHealth
from abcd_ns.engine.train.run_state import ActiveVisit, RunState, VisitKind
from abcd_ns.engine.train.schedule import VisitPlan
from abcd_ns.engine.types import Crop
from abcd_ns.viewer.run_history import MOST_POINTS, BlockRow, RunHistory, Status, time_left
from abcd_ns.viewer.texts import (
    MOST_ROWS,
    block_table,
    clock,
    headline,
    memory_table,
    workers_line,
)


def began(visit: int, block: int | None, sweep: int = 0, steps: int = 10) -> VisitBegan:
    return VisitBegan(visit, sweep, block, steps, views=5, gaussians=100)


def ended(visit: int, block: int | None, sweep: int = 0) -> VisitEnded:
    return VisitEnded(visit, sweep, block, gaussians=100, migrated=0, layer_seconds=0.1, seconds=1.0)


def step(psnr: float, visit: int = 0) -> StepTaken:
    return StepTaken(1, visit, 1, psnr)


def active(block: int, done: int = 0, steps: int = 10) -> ActiveVisit:
    geometry = VisitGeometry(block, {0: Crop(0, 0, 8, 8)})
    return ActiveVisit(0, VisitKind.BLOCK, geometry, sh_degree=0, steps=steps, views=(0,), done=done)


def test_a_block_is_untrained_then_active_then_done():
    history = RunHistory()
    assert history.status(1, views=9) is Status.UNTRAINED
    history.note(began(0, 1), 0.0)
    assert history.status(1, views=9) is Status.ACTIVE
    assert history.status(0, views=9) is Status.UNTRAINED
    history.note(ended(0, 1), 1.0)
    assert history.status(1, views=9) is Status.DONE


def test_a_block_that_hardly_any_view_shows_says_so():
    few = [RunHistory().status(0, views) is Status.UNDER_OBSERVED for views in (0, 2, 3, None)]
    assert few == [True, True, False, False]


def test_during_the_warm_up_no_block_is_active():
    history = RunHistory()
    history.note(began(0, None), 0.0)
    rows = history.rows({0: None, 1: None}, {})
    assert [row.status for row in rows] == [Status.WARM_UP] * 2
    history.note(ended(0, None), 1.0)
    assert history.visits == {}


def test_the_table_gives_each_blocks_last_psnr():
    history = RunHistory()
    history.note(began(0, 0), 0.0)
    history.note(step(10.0), 0.1)
    history.note(step(20.0), 0.2)
    history.note(step(math.nan), 0.3)
    history.note(ended(0, 0), 1.0)
    rows = history.rows({0: 1234, 1: 5}, {0: 9, 1: 1})
    assert [row.psnr for row in rows] == [15.0, None]
    table = block_table(rows)
    assert "| 1 | done | 1,234 | 15.00 | 9 |" in table
    assert "| 2 | under-observed | 5 | - | 1 |" in table


def test_a_table_of_a_finished_run_has_no_empty_columns():
    rows = [BlockRow(0, Status.DONE, 7, None, None), BlockRow(1, Status.UNTRAINED, 0, None, None)]
    lines = [
        "| # | state | Gaussians |",
        "| ---: | --- | ---: |",
        "| 1 | done | 7 |",
        "| 2 | untrained | 0 |",
    ]
    assert block_table(rows).splitlines() == lines


def test_of_many_blocks_the_table_shows_the_urgent_ones():
    history = RunHistory()
    history.note(began(0, 90), 0.0)
    rows = history.rows(dict.fromkeys(range(100), 1), {**dict.fromkeys(range(100), 9), 70: 0})
    lines = block_table(rows).splitlines()
    shown = [int(line.split("|")[1]) for line in lines if line.startswith("| ") and line[2].isdigit()]
    assert shown == [*range(1, MOST_ROWS - 1), 71, 91]
    assert lines[-1] == "100 blocks: 1 active, 1 under-observed, 98 untrained."


def test_the_curve_has_a_point_every_other_second():
    history = RunHistory()
    for tick in range(100):
        history.note(step(10.0 + tick), 0.1 * tick)
    assert history.curve[0] == (0.0, 10.0)
    gaps = [b - a for (a, _), (b, _) in zip(history.curve, history.curve[1:], strict=False)]
    assert min(gaps) >= 2.0 - 1e-9
    # Each point is the mean of the steps since the last one: 1 to 20, then 21 to 40.
    assert history.curve[1][1] == pytest.approx(10 + 10.5)
    assert history.curve[2][1] == pytest.approx(10 + 30.5)


def test_the_curve_of_a_short_run_ends_where_it_does():
    history = RunHistory()
    for tick in range(3):
        history.note(step(10.0 + tick), 0.5 * tick)
    assert history.curve == [(0.0, 10.0)]
    history.end(1.2)
    history.end(1.3)  # nothing came after the end
    assert history.curve == [(0.0, 10.0), (1.2, 11.5)]


def test_a_long_curve_is_thinned_and_keeps_its_end():
    history = RunHistory()
    for tick in range(3 * MOST_POINTS):
        history.note(step(float(tick)), 3.0 * tick)
        assert history.curve[-1][0] == 3.0 * tick
        assert len(history.curve) <= MOST_POINTS
    assert history.curve == sorted(history.curve)
    assert len(history.curve) > MOST_POINTS / 2


def test_visits_of_workers_are_under_way_together():
    history = RunHistory()
    for visit, block in ((4, 0), (5, 2)):
        history.note(began(visit, block), 1.0)
        history.note(StepTaken(0, visit, visit_step=visit, psnr=10.0 * block), 2.0)
    statuses = [history.status(block, 9) for block in range(3)]
    assert statuses == [Status.ACTIVE, Status.UNTRAINED, Status.ACTIVE]
    history.note(ended(4, 0), 3.0)
    assert history.status(0, 9) is Status.DONE
    assert history.psnr == {0: 0.0}
    history.note(ended(5, 2), 3.0)
    assert history.psnr == {0: 0.0, 2: 20.0}


def test_what_workers_do_in_words():
    seen = [WorkerSeen(0, 2, 7, 40, 3, 1, 0.1), WorkerSeen(1, None, 0, 0, 0, 0, 0.0)]
    assert workers_line(seen).splitlines() == [
        "Worker 1: block 3, step 7 of 40; 3 visits, replaced 1x  ",
        "Worker 2: is starting; 0 visits",
    ]


def a_run(step: int, progress: float, price: float = 8.0):
    density = SimpleNamespace(price=price, strategy="error")
    return SimpleNamespace(
        config=SimpleNamespace(density=density, recipe=SimpleNamespace(exact=False)),
        state=SimpleNamespace(step=step),
        stopwatch=SimpleNamespace(seconds=10.0),
        progress=progress,
        views=dict.fromkeys(range(20)),
        scene=SimpleNamespace(tree=SimpleNamespace(num_blocks=2)),
    )


def test_time_left_is_that_of_steps_and_of_the_final_pruning():
    assert time_left(a_run(step=0, progress=0.0)) is None
    assert time_left(a_run(step=100, progress=0.25, price=0.0)) == pytest.approx(30.0)
    pruning = 0.1 * (12.5 + 0.5 * 7 * 5)  # 400 steps: 12.5 views rank, 5 tell
    assert time_left(a_run(step=100, progress=0.25)) == pytest.approx(30.0 + pruning)
    assert time_left(a_run(step=100, progress=1.0)) == pytest.approx(0.1 * (5 + 0.5 * 7 * 5))


def test_a_resumed_run_knows_which_blocks_had_their_visit():
    state = RunState(
        visit=3, queue=[VisitPlan(2, 10)], views={0: 9, 1: 9, 2: 9, 3: 0, 4: 9}, active=active(1, done=4)
    )
    state.health = {WHOLE: BlockHealth(visits=1), 0: BlockHealth(visits=1)}
    history = RunHistory.resumed(state)
    statuses = [history.status(block, state.views[block]) for block in range(5)]
    none = Status.UNTRAINED  # the last one, whose share of the epoch was no step, too
    assert statuses == [Status.DONE, Status.ACTIVE, none, Status.UNDER_OBSERVED, none]
    state.sweep, state.health[2] = 1, BlockHealth(visits=1)
    assert RunHistory.resumed(state).status(2, 9) is Status.DONE
    assert RunHistory.resumed(RunState()) == RunHistory()


def test_words():
    assert clock(3725.9) == "1:02:05"
    assert clock(None) == "unknown"
    assert headline("Block 3, step 4 of 9", 0.25, 90.0) == (
        "**Block 3, step 4 of 9**  \n25% of the run, 0:01:30 left"
    )
    assert memory_table([("RAM", 3 * 2**29, 2**34), ("layers", 2**20, 2**32)]).splitlines()[2:] == [
        "| RAM | 1.5 GiB | 16.0 GiB |",
        "| layers | 1 MiB | 4.0 GiB |",
    ]
