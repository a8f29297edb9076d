"""Workers that are forked for each visit: nobody can tell from the result, whatever befalls them."""

import os
import signal
import time
from contextlib import suppress
from multiprocessing import Event
from types import SimpleNamespace

import psutil
import pytest
import torch

from abcd_ns.cluster import forked_workers
from abcd_ns.cluster.forked_workers import ForkedWorkers, can_fork
from abcd_ns.cluster.visit_worker import VisitWorker
from abcd_ns.engine.events import WorkerLost, WorkersSeen
from abcd_ns.engine.render.cpu.backend import TorchRasterizer
from abcd_ns.engine.train.training_loop import train, train_step
from abcd_ns.errors import UserError
from tests.cluster.conftest import GROWING, make_run, setup_of
from tests.reference.scenes import equal, listen, whole_scene
from tests.reference.store_helpers import wait_until

pytestmark = pytest.mark.skipif(not can_fork(torch.device("cpu")), reason="needs Linux without a GPU")


@pytest.fixture
def make(tmp_path, views, photos):
    """Makes the run that `steady` is of, by two workers; `target` is told of each sample."""

    def made(target=lambda _: None, rasterizer=TorchRasterizer()):  # noqa: B008
        def watched(sample):
            target(sample)
            return photos.target(sample)

        def workers_of(run):
            return ForkedWorkers(2, VisitWorker(setup_of(run), rasterizer, watched))

        return make_run(tmp_path / "forked", views, workers_of, lag=4, density=GROWING)

    return made


def once(folder, act):
    """Does something in the first process that comes along, and nowhere else."""
    here, marker = os.getpid(), folder / "done"

    def target(_):
        if os.getpid() != here:
            with suppress(FileExistsError):
                marker.touch(exist_ok=False)
                act()

    return target


def raising(error: Exception):
    def act():
        raise error

    return act


def test_a_run_is_that_of_one_process_and_whoever_is_killed_is_replaced(make, photos, steady):
    run, alive = make(), set()
    lost, seen = listen(run, WorkerLost), listen(run, WorkersSeen)
    while not run.finished:
        train_step(run, photos)
        if len(lost) < 4 and (pids := run.workers.pids):
            os.kill(pids[0], signal.SIGKILL)
        alive |= set(run.workers.pids)
    assert len(lost) >= 2
    assert len(steady[0]) > 90  # blocks grew
    assert equal(steady[0], whole_scene(run))
    assert [worker.visits > 0 for worker in seen[-1].workers] == [True, True]
    assert run.workers.idle == 2
    assert not any(map(psutil.pid_exists, alive))


FULL = RuntimeError("DefaultCPUAllocator: can't allocate memory")


@pytest.mark.parametrize("trouble", [raising(FULL), lambda: time.sleep(600)])
def test_a_visit_without_memory_or_a_word_is_assigned_again(
    make, photos, steady, tmp_path, monkeypatch, trouble
):
    monkeypatch.setattr(forked_workers, "SILENCE", 3.0)
    run = make(once(tmp_path, trouble))
    train(run, photos)
    assert sum(worker.deaths for worker in run.workers.seen()) == 1
    assert equal(steady[0], whole_scene(run))


def test_while_time_is_paused_nobody_trains(make, photos, steady):
    run = make()
    while not run.workers.pids:
        train_step(run, photos)
    run.pause()
    before, pids = run.stopwatch.seconds, run.workers.pids
    still = {psutil.STATUS_STOPPED, psutil.STATUS_ZOMBIE}
    wait_until(lambda: {psutil.Process(pid).status() for pid in pids} <= still)
    assert run.stopwatch.seconds == before
    train(run, photos)
    assert equal(steady[0], whole_scene(run))


class Timing:
    """Its visits end when they may, with what they took, by the clock that it is given and by another."""

    def __init__(self) -> None:
        self.begun, self.may_end = Event(), Event()

    def visit(self, *given):
        clock = given[-1]
        began, started = clock(), time.perf_counter()
        self.begun.set()
        self.may_end.wait()
        raise UserError(f"{clock() - began} {time.perf_counter() - started}")


def test_what_is_paused_counts_for_no_visit():
    timing = Timing()
    workers = ForkedWorkers(1, timing)
    workers.submit(SimpleNamespace(number=1, task=None, state=lambda: None, drawn={}))
    timing.begun.wait()
    assert workers.hold()
    assert workers.hold()  # as good as once
    time.sleep(0.5)
    workers.resume()
    timing.may_end.set()
    assert workers.wait(60.0) == []  # it lives
    with pytest.raises(UserError) as told:
        workers.wait(60.0)
    counted, passed = map(float, str(told.value).split())
    assert 0.5 <= passed - counted < passed


class Slow(TorchRasterizer):
    def cuts(self, *args, **options):
        for cut in super().cuts(*args, **options):
            time.sleep(0.4)
            yield cut


def test_one_that_draws_layers_for_long_is_not(make, views, photos, monkeypatch):
    monkeypatch.setattr(forked_workers, "SILENCE", 1.5)
    run = make(rasterizer=Slow())
    lost = listen(run, WorkerLost)
    while run.state.visit < 3:
        train_step(run, photos)
    run.workers.close()
    assert 0.4 * len(views) > 1.5
    assert not lost


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (ValueError("two\nlines"), r"ValueError: two \(test_forked\.py:\d+, in act\)\..*workers 1"),
        (UserError("The photo is gone: put it back."), r"^The photo is gone: put it back\.$"),
    ],
)
def test_any_other_error_ends_the_run_in_one_line(make, photos, tmp_path, error, words):
    run = make(once(tmp_path, raising(error)))
    with pytest.raises(UserError, match=words) as raised:
        train(run, photos)
    assert "\n" not in str(raised.value)
    pids = run.workers.pids
    run.workers.close()
    assert not any(map(psutil.pid_exists, pids))


@pytest.mark.parametrize("held", [False, True])
def test_no_worker_outlives_the_training_process(make, held):
    """Not even one that is killed; `kill -9` runs no handler. Nor does one that stands still."""
    reads, writes = os.pipe()
    driver = os.fork()
    if driver == 0:
        try:
            run = make(lambda _: time.sleep(600))
            run._assign()
            if held:
                run.workers.hold()
            os.write(writes, " ".join(map(str, run.workers.pids)).encode())
            time.sleep(600)
        finally:
            os._exit(1)
    os.close(writes)
    pids = [int(pid) for pid in os.read(reads, 100).split()]
    os.close(reads)
    assert len(pids) == 2
    assert all(map(psutil.pid_exists, pids))
    os.kill(driver, signal.SIGKILL)
    os.waitpid(driver, 0)
    wait_until(lambda: not any(map(psutil.pid_exists, pids)))
