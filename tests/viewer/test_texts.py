"""What panel and terminal say of a run: states of blocks, the table, time left, how to reach the viewer."""

from types import SimpleNamespace

import pytest

from abcd_ns.engine.layers.footprints import VisitGeometry
from abcd_ns.engine.store.special_blocks import WHOLE
from abcd_ns.engine.train.density.control import DensityConfig
from abcd_ns.engine.train.run_state import ActiveVisit, BlockHealth, RunState, VisitKind
from abcd_ns.engine.types import Crop
from abcd_ns.viewer import texts
from abcd_ns.viewer.texts import BlockRow, Status


def test_a_block_is_untrained_then_active_then_done():
    def statuses(state: RunState, *active: int) -> list[Status]:
        return [texts.status_of(block, state, active) for block in range(5)]

    state = RunState(views={0: 9, 1: 9, 2: 2, 3: 0})
    state.health = {WHOLE: BlockHealth(visits=1), 0: BlockHealth(visits=1), 4: BlockHealth(oversized=3)}
    few, none = Status.UNDER_OBSERVED, Status.UNTRAINED  # the last one's share of the epoch was no step
    assert statuses(state, 1) == [Status.DONE, Status.ACTIVE, few, few, none]
    assert statuses(state, 0, 3) == [Status.ACTIVE, none, few, Status.ACTIVE, none]
    geometry = VisitGeometry(WHOLE, {0: Crop(0, 0, 8, 8)})
    state.active = ActiveVisit(0, VisitKind.COARSE, geometry, sh_degree=0, steps=10, views=(0,))
    assert statuses(state) == [Status.WARM_UP] * 5


def test_of_many_blocks_the_table_shows_the_urgent_ones():
    urgent = {70: Status.UNDER_OBSERVED, 90: Status.ACTIVE}
    rows = [BlockRow(b, urgent.get(b, Status.UNTRAINED), 1, None, 9) for b in range(100)]
    lines = texts.block_table(rows).splitlines()
    shown = [int(line.split("|")[1]) for line in lines if line.startswith("| ") and line[2].isdigit()]
    assert shown == [*range(1, texts.MOST_ROWS - 1), 71, 91]
    assert lines[-1] == "100 blocks: 1 active, 1 under-observed, 98 untrained."


def a_run(step: int, progress: float, min_contribution: float = 8.0):
    density = DensityConfig(min_contribution=min_contribution)
    return SimpleNamespace(
        config=SimpleNamespace(density=density, recipe=SimpleNamespace(exact=False)),
        state=SimpleNamespace(step=step),
        stopwatch=SimpleNamespace(seconds=10.0),
        progress=progress,
        views=dict.fromkeys(range(20)),
        scene=SimpleNamespace(tree=SimpleNamespace(num_blocks=2)),
    )


def test_time_left_is_that_of_steps_and_of_the_final_pruning():
    assert texts.time_left(a_run(step=0, progress=0.0)) is None
    assert texts.time_left(a_run(step=100, progress=0.25, min_contribution=0.0)) == pytest.approx(30.0)
    pruning = 0.1 * (12.5 + 0.5 * 7 * 5)  # 400 steps: 12.5 views rank, 5 tell
    assert texts.time_left(a_run(step=100, progress=0.25)) == pytest.approx(30.0 + pruning)
    assert texts.time_left(a_run(step=100, progress=1.0)) == pytest.approx(0.1 * (5 + 0.5 * 7 * 5))


@pytest.mark.parametrize("mark", [None, "a file", "Kubernetes"])
def test_a_viewer_in_a_container_names_the_flag_that_opens_it(tmp_path, monkeypatch, mark):
    monkeypatch.setattr(texts, "CONTAINER_MARKS", (tmp_path / "other", tmp_path / ".dockerenv"))
    monkeypatch.delenv("KUBERNETES_SERVICE_HOST", raising=False)
    if mark == "a file":
        (tmp_path / ".dockerenv").touch()
    if mark == "Kubernetes":
        monkeypatch.setenv("KUBERNETES_SERVICE_HOST", "10.0.0.1")
    for host in ("127.0.0.1", "localhost"):
        assert ("--viewer.websocket-host 0.0.0.0" in (texts.reach(host) or "")) == (mark is not None)
    assert [texts.reach(host) for host in ("0.0.0.0", "10.0.0.5", "::")] == [None] * 3  # they are open
