"""A visit that lasts as long as the run: one block's, saved by the clock."""

import time

from abcd_ns.engine.events import SweepEnded, VisitBegan, VisitEnded
from abcd_ns.engine.store.special_blocks import LIVE
from abcd_ns.engine.train.training_loop import train
from tests.engine.store.disks import PATIENCE, Disk, on_disk
from tests.reference.scenes import make_coordinator


def test_one_block_is_one_visit(tmp_path, views, photos, start):
    coordinator = make_coordinator(tmp_path, start, views, blocks=1, steps=50, commit_seconds=60.0)
    disk, events = Disk(coordinator.scene.store), []
    coordinator.announce.subscribe(events.append)
    train(coordinator, photos)
    (begun,) = (event for event in events if isinstance(event, VisitBegan))
    (ended,) = (event for event in events if isinstance(event, VisitEnded))
    assert (begun.steps, begun.views, ended.block) == (50, 5, 0)
    assert [event.sweep for event in events if isinstance(event, SweepEnded)] == [0]
    assert [(written, state["step"]) for written, state in disk.commits] == [({0}, 50)]


def test_a_long_visit_is_saved_by_the_clock(tmp_path, views, photos, start):
    coordinator = make_coordinator(tmp_path, start, views, blocks=1, steps=50, commit_seconds=1e-6)
    train(coordinator, photos, steps=10)
    coordinator.scene.flush()
    assert on_disk(coordinator.scene)["step"] == 10
    assert coordinator.scene.rows(LIVE) == coordinator.count()
    coordinator.close()
    again = make_coordinator(tmp_path, start, views, resume=True, steps=50)
    assert again.state.step == 10


def test_what_a_long_visit_puts_to_rest_waits_for_no_clock(tmp_path, views, photos, start):
    """Though the last write has only just begun, of something older: else a kill would lose twice as much."""
    coordinator = make_coordinator(tmp_path, start, views, blocks=1, steps=50, commit_seconds=60.0)
    train(coordinator, photos, steps=3)
    assert on_disk(coordinator.scene).get("step", 0) == 0
    coordinator.scene._rested -= 61.0
    train(coordinator, photos, steps=1)
    deadline = time.monotonic() + PATIENCE
    while on_disk(coordinator.scene).get("step") != 4 and time.monotonic() < deadline:
        time.sleep(0.01)
    assert on_disk(coordinator.scene)["step"] == 4
