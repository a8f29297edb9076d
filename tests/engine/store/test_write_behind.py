"""Writing beside the training: what waits, what is durable when, errors, forks, and what stays in RAM."""

import os
import sys
import threading
from dataclasses import replace

import pytest
import torch

from abcd_ns.engine.events import VisitBegan, VisitEnded
from abcd_ns.engine.gaussians.block_state import BlockState
from abcd_ns.engine.space.partition import build_kd
from abcd_ns.engine.space.visibility import bounds_of
from abcd_ns.engine.store import ParameterStore, StoreError
from abcd_ns.engine.store.coarse_model import stored_blocks
from abcd_ns.engine.store.commit import with_pending
from abcd_ns.engine.store.scene import StoredScene
from abcd_ns.engine.store.special_blocks import ACTIVE, PENDING
from abcd_ns.engine.train.training_loop import train, train_step
from abcd_ns.engine.types import Gaussians
from tests.reference.scenes import STILL, assert_same_state, equal, listen, random_gaussians, stop
from tests.reference.store_helpers import PATIENCE, Disk, on_disk, wait_until

SOON = 1e-6
"""Seconds."""


@pytest.fixture
def scene(tmp_path) -> StoredScene:
    """Of four blocks of ten, nothing of it in RAM."""
    gaussians = random_gaussians(40)
    tree = build_kd(gaussians.means, 4)
    store = ParameterStore.create(tmp_path / "store", {"tree": tree.to_json()})
    store.commit(stored_blocks(tree, gaussians), state={"step": 0})
    return StoredScene(tree, store)


@pytest.fixture
def disk(scene) -> Disk:
    return Disk(scene.store)


def persist(scene: StoredScene, step: int, *blocks: int, within: float = PATIENCE) -> None:
    """Persist blocks, each with one Gaussian fewer."""
    fewer = {block: BlockState.fresh(scene.state(block).gaussians[1:]) for block in blocks}
    scene.persist(scene.tree, fewer, {"step": step}, within=within)


def hold_up(scene: StoredScene, disk: Disk, step: int, block: int) -> None:
    disk.free.clear()
    persist(scene, step, block, within=SOON)
    assert disk.asked.wait(PATIENCE)


@pytest.mark.parametrize(
    "which", [None, lambda means, scales: ((means + scales)[:, 0] * 1000).long() % 2 == 0]
)
def test_what_waits_is_left_out_and_pending_migrants_are_drawn_picked_or_not(scene, which):
    state = scene.state(1)
    deferred = torch.arange(len(state)) % 3 == 0
    migrants = BlockState.fresh(state.gaussians[2:5])  # in the block's cell
    scene.persist(scene.tree, {1: replace(state, deferred=deferred), PENDING: migrants}, {}, within=60.0)
    seen = Gaussians.cat([state.gaussians[~deferred], migrants.gaussians])
    expected = seen if which is None else seen[which(seen.means, seen.scales)]
    assert which is None or 0 < len(expected) < len(seen)
    assert equal(expected, scene.drawn(1, "cpu", which))


def test_bounds_follow_migrants_without_another_look_at_the_block(scene, monkeypatch):
    state = scene.state(1)
    assert scene.bounds(1).upper.tolist() == bounds_of(state.gaussians).upper.tolist()
    monkeypatch.setattr(scene, "stored", None)
    for rows in ([0, 1], [4], []):
        migrants = BlockState.fresh(state.gaussians[torch.tensor(rows, dtype=torch.long)])
        migrants.gaussians.scales[:] += 2.0
        scene.persist(scene.tree, {PENDING: migrants}, {}, within=60.0)
        box, expected = scene.bounds(1), bounds_of(Gaussians.cat([state.gaussians, migrants.gaussians]))
        assert box.lower.tolist() == expected.lower.tolist()
        assert box.upper.tolist() == expected.upper.tolist()


# The queue


def test_nothing_is_written_before_its_time_and_then_all_at_once(scene, disk):
    for step in (1, 2, 3):
        persist(scene, step, step % 2)
    assert disk.commits == []
    assert on_disk(scene) == {"step": 0}
    assert [scene.count(0), scene.count(1)] == [9, 8]
    persist(scene, 3, within=SOON)
    wait_until(lambda: disk.commits)
    assert disk.commits == [({0, 1}, {"step": 3})]
    assert on_disk(scene) == {"step": 3}


def test_one_snapshot_is_written_and_one_waits_however_many_come(scene, disk):
    hold_up(scene, disk, 1, 0)
    for step in (2, 3, 4):
        persist(scene, step, step - 1, within=SOON)
    disk.free.set()
    scene.flush()
    assert disk.commits == [({0}, {"step": 1}), ({1, 2, 3}, {"step": 4})]
    assert scene.unsaved_bytes == 0


def test_what_waits_never_takes_more_ram_than_there_is(scene, disk):
    scene.ram_bytes = scene.state(0).packed().nbytes
    scene.persist(scene.tree, {0: scene.state(0)}, {"step": 1}, within=PATIENCE)
    assert disk.commits == []
    disk.free.clear()
    given = scene.tree, {1: scene.state(1)}, {"step": 2}, PATIENCE
    thread = threading.Thread(target=scene.persist, args=given, daemon=True)  # it has to wait
    thread.start()
    assert disk.asked.wait(PATIENCE)
    assert thread.is_alive()
    disk.free.set()
    thread.join(PATIENCE)
    assert disk.commits == [({0, 1}, {"step": 2})]


def test_a_large_active_block_is_written_beside_the_training_and_no_second_copy_is_made(scene, disk):
    scene.ram_bytes = 1
    disk.free.clear()
    scene.persist(scene.tree, {ACTIVE: scene.state(0)}, {"step": 1}, within=SOON)
    assert disk.asked.wait(PATIENCE)
    assert disk.commits == []
    assert not scene.is_due(SOON)
    disk.free.set()
    wait_until(lambda: scene.is_due(SOON))
    assert disk.commits == [({ACTIVE}, {"step": 1})]


# Errors


def test_what_fails_after_a_write_is_said_and_nobody_waits_for_ever(scene, monkeypatch):
    def fails(_) -> None:
        raise MemoryError("no more")

    with monkeypatch.context() as patched:
        patched.setattr(scene._writer, "_written", fails)
        with pytest.raises(MemoryError):
            persist(scene, 1, 0, within=0.0)
    scene.flush()
    assert on_disk(scene) == {"step": 1}
    assert scene.unsaved_bytes == 0


def test_a_write_that_failed_is_told_once_and_made_good_by_the_next(scene, disk):
    disk.refuses = True
    persist(scene, 1, 0)
    with pytest.raises(StoreError, match="full"):
        scene.flush()
    with pytest.raises(StoreError, match="full"):
        persist(scene, 2, 1, within=0.0)
    assert (on_disk(scene), scene.count(0), scene.count(1)) == ({"step": 0}, 9, 9)
    disk.refuses = False
    scene.flush()
    assert disk.commits == [({0, 1}, {"step": 2})]
    again = StoredScene(scene.tree, ParameterStore.open(scene.store.folder, read_only=True))
    for block in range(4):
        assert_same_state(again.state(block), scene.state(block))


def test_a_fork_waits_for_the_write_and_the_child_can_read(scene, disk):
    hold_up(scene, disk, 1, 0)
    persist(scene, 2, 1, within=10 * PATIENCE)
    threading.Timer(0.2, disk.free.set).start()
    pid = os.fork()
    if pid == 0:
        sizes = [len(scene.state(number)) for number in range(4)]
        os._exit(0 if sizes == [9, 9, 10, 10] else 1)
    assert disk.commits == [({0}, {"step": 1})]
    _, status = os.waitpid(pid, 0)
    assert os.waitstatus_to_exitcode(status) == 0
    scene.flush()
    assert on_disk(scene) == {"step": 2}


def test_a_picture_that_is_broken_off_leaves_no_lock_behind(scene):
    def trace(frame, event, _):
        if frame.f_code.co_name == "__exit__" and "threading" in frame.f_code.co_filename and event == "line":
            raise KeyboardInterrupt
        return trace

    def draw():
        sys.settrace(trace)
        with pytest.raises(KeyboardInterrupt):
            scene.drawn(0, "cpu")
        sys.settrace(None)

    viewer = threading.Thread(target=draw)
    viewer.start()
    viewer.join()
    got = scene._writer.mutex.acquire(timeout=1.0)
    assert got
    scene._writer.mutex.release()


# The pending migrants


def shaken(coordinator, photos) -> None:
    """A step, after which Gaussians are all over the place."""
    train_step(coordinator, photos)
    means = coordinator.params["means"].detach()
    means += 0.05 * torch.randn(means.shape, generator=torch.Generator().manual_seed(0))


def test_a_visit_writes_its_block_and_the_pending_migrants_alone(make, photos):
    coordinator = make(blocks=4, steps=30, density=STILL, commit_seconds=0.0)
    disk, ended = Disk(coordinator.scene.store), listen(coordinator, VisitEnded)
    while not coordinator.finished:
        shaken(coordinator, photos)
    assert sum(event.migrated for event in ended) > 0
    assert len(disk.commits) == len(ended)
    for (written, _), event in zip(disk.commits, ended, strict=True):
        assert event.block in written <= {event.block, PENDING}
        assert PENDING in written or event.migrated == 0


def test_pending_migrants_are_drawn_survive_a_stop_and_join(make, photos):
    options = {"blocks": 2, "steps": 60, "density": STILL}
    coordinator = make(**options)
    while coordinator.scene.pending is None or not len(coordinator.scene.pending):
        shaken(coordinator, photos)
    (block,) = coordinator.scene._pending_by_block
    expected, rows = with_pending(coordinator.scene, block), coordinator.scene.rows(block)
    assert len(coordinator.scene.gaussians(block)) == coordinator.scene.count(block) == len(expected) > rows
    stop(coordinator)
    again = make(resume=True, **options)
    assert_same_state(with_pending(again.scene, block), expected)
    begun = listen(again, VisitBegan)
    while not begun or begun[-1].block != block:
        train_step(again, photos)
    assert begun[-1].gaussians == len(expected)
    while again.state.active is not None:
        train_step(again, photos)
    assert again.scene.pending_for(block) is None
    assert again.scene.clocks(block).visits == expected.clocks.visits + 1


# One block's visit, which lasts as long as the run


def test_a_long_visit_is_saved_by_the_clock(make, photos):
    """Though the last write has only just begun, of something older: else a kill would lose twice as much."""
    coordinator = make(blocks=1, steps=50, commit_seconds=60.0)
    train(coordinator, photos, steps=3)
    assert on_disk(coordinator.scene).get("step", 0) == 0
    coordinator.scene._persisted -= 61.0
    train(coordinator, photos, steps=1)
    wait_until(lambda: on_disk(coordinator.scene).get("step") == 4)
    assert coordinator.scene.rows(ACTIVE) == coordinator.count()
    coordinator.close()
    assert make(resume=True, steps=50).state.step == 4
