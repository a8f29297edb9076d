"""Writing beside the training: what waits, what is durable when, errors, forks, and what stays in RAM."""

import os
import sys
import threading
import time
import weakref
from dataclasses import replace

import pytest
import torch

from abcd_ns.engine.events import VisitBegan, VisitEnded
from abcd_ns.engine.gaussians.block_state import BlockState
from abcd_ns.engine.gaussians.packed import DRAWN
from abcd_ns.engine.space.partition import build_kd
from abcd_ns.engine.store import ParameterStore, StoreError, parameter_store
from abcd_ns.engine.store.block_memory import BlockMemory
from abcd_ns.engine.store.scaffold import blocks_at_rest
from abcd_ns.engine.store.scene import StoredScene
from abcd_ns.engine.store.settle import with_mail
from abcd_ns.engine.store.special_blocks import INBOX, LIVE
from abcd_ns.engine.train.density.control import DensityConfig
from abcd_ns.engine.train.training_loop import train, train_step
from abcd_ns.engine.types import Gaussians
from tests.engine.store.disks import PATIENCE, Disk, on_disk
from tests.reference.scenes import listen, make_coordinator, random_gaussians, whole_scene

STILL = DensityConfig(strategy="off")


@pytest.fixture
def scene(tmp_path) -> StoredScene:
    """Of four blocks, nothing of it in RAM."""
    gaussians = random_gaussians(40)
    tree = build_kd(gaussians.means, 4)
    store = ParameterStore.create(tmp_path / "store", {"tree": tree.to_json()})
    store.commit(blocks_at_rest(tree, gaussians), state={"step": 0})
    return StoredScene(tree, store)


class Guarded(dict):
    """Whoever goes through it must hold the lock: the writer takes things out."""

    def __init__(self, scene: StoredScene) -> None:
        super().__init__(scene._unsaved)
        self._lock = scene._writer.lock

    def values(self):
        assert self._lock._is_owned()
        return super().values()


def test_what_is_not_on_disk_yet_is_counted_under_the_lock(scene):
    scene._unsaved = Guarded(scene)
    scene.rest(scene.tree, {0: moved(scene.state(0), 1)}, {"step": 1}, within=60.0)
    assert scene.cached_bytes > 0


def moved(state: BlockState, step: int) -> BlockState:
    """Another content for the same block."""
    return BlockState.fresh(state.gaussians[: len(state) - step])


def equal(a: BlockState, b: BlockState) -> bool:
    (first, meta), (second, other) = a.packed(), b.packed()
    return meta == other and all(torch.equal(value, second[name]) for name, value in first.items())


# What others draw of a block at rest


def every_other(means, scales):
    return ((means[:, 0] + scales[:, 1]) * 1000).long() % 2 == 0


@pytest.mark.parametrize("which", [None, every_other])
def test_who_waits_is_left_out_and_mail_is_drawn_picked_or_not(scene, which):
    state = scene.state(1)
    waits = torch.arange(len(state)) % 3 == 0
    # Mail lies in the block's cell.
    mail = BlockState.fresh(state.gaussians[2:5])
    scene.rest(scene.tree, {1: replace(state, waits=waits), INBOX: mail}, {}, within=60.0)
    seen = Gaussians.cat([state.gaussians[~waits], mail.gaussians])
    expected = seen if which is None else seen[which(seen.means, seen.scales)]
    drawn = scene.drawn(1, "cpu", which)
    assert which is None or 0 < len(expected) < len(seen)
    assert all(torch.equal(value, getattr(drawn, name)) for name, value in expected.items())


# The queue


def test_nothing_is_written_before_its_time_and_then_all_at_once(scene):
    disk = Disk(scene.store)
    for step in (1, 2, 3):
        scene.rest(scene.tree, {step % 2: moved(scene.state(step % 2), 1)}, {"step": step}, within=PATIENCE)
    assert disk.commits == []
    assert on_disk(scene) == {"step": 0}
    assert [scene.count(0), scene.count(1)] == [9, 8]
    scene.rest(scene.tree, {}, {"step": 3}, within=1e-6)
    deadline = time.monotonic() + PATIENCE
    while not disk.commits and time.monotonic() < deadline:
        time.sleep(0.01)
    assert disk.commits == [({0, 1}, {"step": 3})]
    assert on_disk(scene) == {"step": 3}


def test_one_snapshot_is_written_and_one_waits_however_many_come(scene):
    disk = Disk(scene.store)
    disk.free.clear()
    scene.rest(scene.tree, {0: moved(scene.state(0), 1)}, {"step": 1}, within=1e-6)
    assert disk.asked.wait(PATIENCE)
    for step in (2, 3, 4):
        scene.rest(scene.tree, {step - 1: moved(scene.state(step - 1), 1)}, {"step": step}, within=1e-6)
    disk.free.set()
    scene.flush()
    assert disk.commits == [({0}, {"step": 1}), ({1, 2, 3}, {"step": 4})]
    assert scene.unsaved_bytes == 0


def test_what_waits_never_takes_more_ram_than_there_is(scene):
    disk = Disk(scene.store)
    scene.ram_bytes = scene.state(0).packed().nbytes
    scene.rest(scene.tree, {0: scene.state(0)}, {"step": 1}, within=PATIENCE)
    assert disk.commits == []
    disk.free.clear()
    more = (scene.tree, {1: scene.state(1)}, {"step": 2}, PATIENCE)
    rests = threading.Thread(target=scene.rest, args=more, daemon=True)
    rests.start()
    assert disk.asked.wait(PATIENCE)
    assert rests.is_alive()
    disk.free.set()
    rests.join(PATIENCE)
    assert disk.commits == [({0, 1}, {"step": 2})]


def test_a_large_live_block_is_written_beside_the_training_and_a_second_one_waits(scene):
    disk = Disk(scene.store)
    scene.ram_bytes = 1
    disk.free.clear()
    scene.rest(scene.tree, {LIVE: scene.state(0)}, {"step": 1}, within=1e-3)
    assert disk.asked.wait(PATIENCE)
    assert disk.commits == []
    more = (scene.tree, {LIVE: scene.state(1)}, {"step": 2}, 1e-3)
    rests = threading.Thread(target=scene.rest, args=more, daemon=True)
    rests.start()
    rests.join(0.2)
    assert rests.is_alive()
    disk.free.set()
    rests.join(PATIENCE)
    assert not rests.is_alive()
    scene.flush()
    assert disk.commits == [({LIVE}, {"step": 1}), ({LIVE}, {"step": 2})]


def test_with_no_seconds_to_wait_all_is_durable_at_once(scene):
    scene.rest(scene.tree, {0: moved(scene.state(0), 2)}, {"step": 1}, within=0.0)
    assert on_disk(scene) == {"step": 1}


def test_what_fails_after_a_write_is_said_and_nobody_waits_for_ever(scene, monkeypatch):
    def fails(_) -> None:
        raise MemoryError("no more")

    with monkeypatch.context() as patched:
        patched.setattr(scene._writer, "_written", fails)
        with pytest.raises(MemoryError):
            scene.rest(scene.tree, {0: moved(scene.state(0), 1)}, {"step": 1}, within=0.0)
    scene.flush()
    assert on_disk(scene) == {"step": 1}
    assert scene.unsaved_bytes == 0


def test_the_thread_ends_when_all_is_written(scene):
    scene.rest(scene.tree, {}, {"step": 1}, within=PATIENCE)
    assert scene._writer._thread.is_alive()
    scene.flush()
    deadline = time.monotonic() + PATIENCE
    while scene._writer._thread is not None and time.monotonic() < deadline:
        time.sleep(0.01)
    assert scene._writer._thread is None


# Errors


def test_a_write_that_failed_is_told_once_and_made_good_by_the_next(scene):
    disk = Disk(scene.store)
    disk.refuses = True
    scene.rest(scene.tree, {0: moved(scene.state(0), 1)}, {"step": 1}, within=PATIENCE)
    with pytest.raises(StoreError, match="full"):
        scene.flush()
    with pytest.raises(StoreError, match="full"):
        scene.rest(scene.tree, {1: moved(scene.state(1), 1)}, {"step": 2}, within=0.0)
    assert (on_disk(scene), scene.count(0), scene.count(1)) == ({"step": 0}, 9, 9)
    disk.refuses = False
    scene.flush()
    assert disk.commits == [({0, 1}, {"step": 2})]
    again = StoredScene(scene.tree, ParameterStore.open(scene.store.folder, read_only=True))
    assert all(equal(again.state(block), scene.state(block)) for block in range(4))


def test_a_run_hears_of_a_full_disk_and_can_be_saved_when_there_is_room(tmp_path, views, photos, start):
    coordinator = make_coordinator(tmp_path, start, views, blocks=3, steps=60, commit_seconds=1e-6)
    disk = Disk(coordinator.scene.store)
    train(coordinator, photos, steps=2)
    disk.refuses = True
    with pytest.raises(StoreError, match="full"):
        train(coordinator, photos)
    disk.refuses = False
    coordinator.save()
    assert on_disk(coordinator.scene)["step"] == coordinator.state.step > 2
    expected = whole_scene(coordinator)
    coordinator.close()
    again = make_coordinator(tmp_path, start, views, blocks=3, steps=60, resume=True)
    assert all(torch.equal(v, getattr(expected, n)) for n, v in whole_scene(again).items())
    train(again, photos)


# Forks


def test_a_fork_waits_for_the_write_and_the_child_can_read(scene):
    disk, block = Disk(scene.store), scene.state(0)
    disk.free.clear()
    scene.rest(scene.tree, {0: moved(block, 1)}, {"step": 1}, within=1e-6)
    assert disk.asked.wait(PATIENCE)
    scene.rest(scene.tree, {1: moved(scene.state(1), 1)}, {"step": 2}, within=10 * PATIENCE)
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


# RAM


def test_what_only_its_own_visit_needs_goes_first(scene):
    states = [scene.state(number).packed() for number in range(4)]
    rests = [state.part(set(DRAWN)) for state in states]
    memory = BlockMemory(3 * rests[0].nbytes)
    for number in range(3):
        memory.put(number, states[number])
        memory.shrink()
    assert [memory.whole(number) for number in range(3)] == [None] * 3
    assert all(
        memory.drawn(number).tensors["means"] is states[number].tensors["means"] for number in range(3)
    )
    memory.drawn(0)
    memory.put(3, rests[3])
    memory.shrink()
    assert [memory.drawn(number) is None for number in range(4)] == [False, True, False, False]
    assert memory.nbytes == sum(rests[number].nbytes for number in (0, 2, 3))


def test_what_is_not_on_disk_is_never_let_go(scene):
    small = StoredScene(scene.tree, scene.store, ram_bytes=1)
    disk = Disk(scene.store)
    disk.refuses = True
    with pytest.raises(StoreError):
        small.rest(scene.tree, {b: moved(small.state(b), 1) for b in range(4)}, {"step": 1}, within=0.0)
    assert [len(small.state(block)) for block in range(4)] == [9] * 4


def reads(monkeypatch) -> list[str]:
    """The shards that are read from now on."""
    found, read = [], parameter_store.read_shard

    def note(path, names):
        found.append(path.name)
        return read(path, names)

    monkeypatch.setattr(parameter_store, "read_shard", note)
    return found


def test_a_block_is_read_ahead(scene, monkeypatch):
    found = reads(monkeypatch)
    scene.read_ahead(2)
    deadline = time.monotonic() + PATIENCE
    while not found and time.monotonic() < deadline:
        time.sleep(0.01)
    assert len(found) == 1
    assert len(scene.state(2)) == 10
    scene.read_ahead(2)
    scene.flush()
    assert len(found) == 1


def test_no_shard_is_read_twice_where_ram_suffices(tmp_path, views, photos, start, monkeypatch):
    coordinator = make_coordinator(tmp_path, start, views, blocks=3, steps=60, commit_seconds=0.0)
    found = reads(monkeypatch)
    train(coordinator, photos)
    assert coordinator.state.sweep > 0
    assert len(found) == 2 * 3  # their Gaussians for the plan of the sweep; the rest for the first visit


# The inbox


def shaken(coordinator, photos) -> None:
    """A step, after which Gaussians are all over the place."""
    train_step(coordinator, photos)
    with torch.no_grad():
        noise = torch.randn(coordinator.params["means"].shape, generator=torch.Generator().manual_seed(0))
        coordinator.params["means"].add_(0.05 * noise)


def test_a_visit_writes_its_block_and_the_inbox_alone(tmp_path, views, photos, start):
    options = {"blocks": 4, "steps": 60, "density": STILL, "commit_seconds": 0.0}
    coordinator = make_coordinator(tmp_path, start, views, **options)
    disk, ended = Disk(coordinator.scene.store), listen(coordinator, VisitEnded)
    while not coordinator.finished:
        shaken(coordinator, photos)
    assert sum(event.migrated for event in ended) > 0
    assert len(disk.commits) == len(ended)
    for (written, _), event in zip(disk.commits, ended, strict=True):
        assert event.block in written <= {event.block, INBOX}
        assert INBOX in written or event.migrated == 0


def test_those_in_the_inbox_are_drawn_survive_a_stop_and_join(tmp_path, views, photos, start):
    options = {"blocks": 2, "steps": 60, "density": STILL}
    coordinator = make_coordinator(tmp_path, start, views, **options)
    while coordinator.scene.inbox is None or not len(coordinator.scene.inbox):
        shaken(coordinator, photos)
    (block,) = coordinator.scene._mail
    expected, rows = with_mail(coordinator.scene, block), coordinator.scene.rows(block)
    assert len(coordinator.scene.gaussians(block)) == coordinator.scene.count(block) == len(expected) > rows
    coordinator.save()
    coordinator.close()
    again = make_coordinator(tmp_path, start, views, resume=True, **options)
    assert equal(with_mail(again.scene, block), expected)
    begun = listen(again, VisitBegan)
    while not begun or begun[-1].block != block:
        train_step(again, photos)
    assert begun[-1].gaussians == len(expected)
    while again.state.active is not None:
        train_step(again, photos)
    assert again.scene.mail(block) is None
    assert again.scene.clocks(block).visits == expected.clocks.visits + 1


def test_what_was_written_does_not_stay_while_the_next_waits(scene):
    disk = Disk(scene.store)
    disk.free.clear()
    scene._memory.limit = 1
    block = moved(scene.state(0), 1).packed()
    means = weakref.ref(block.tensors["means"])
    scene.rest(scene.tree, {0: block}, {"step": 1}, within=1e-6)
    del block
    assert disk.asked.wait(PATIENCE)
    scene.rest(scene.tree, {1: moved(scene.state(1), 1)}, {"step": 2}, within=PATIENCE)
    disk.free.set()
    deadline = time.monotonic() + PATIENCE / 2
    while means() is not None and time.monotonic() < deadline:
        scene.state(2)  # somebody else has the only place in RAM
        time.sleep(0.01)
    assert means() is None
    assert disk.commits == [({0}, {"step": 1})]


def test_a_picture_that_is_broken_off_leaves_no_lock_behind(scene):
    class BrokenOffError(Exception):
        pass

    def trace(frame, event, _):
        if frame.f_code.co_name == "__exit__" and "threading" in frame.f_code.co_filename and event == "line":
            raise BrokenOffError
        return trace

    def draw():
        sys.settrace(trace)
        try:
            scene.drawn(0, "cpu")
        except BrokenOffError:
            pass
        finally:
            sys.settrace(None)

    viewer = threading.Thread(target=draw)
    viewer.start()
    viewer.join()
    got = scene._writer.mutex.acquire(timeout=1.0)
    assert got
    scene._writer.mutex.release()
