"""Workers over Ray, as real processes that really end; every test is bounded in time."""

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from functools import partial
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch

from abcd_ns.cluster import connect as connecting
from abcd_ns.cluster.assignment import WorkersError
from abcd_ns.cluster.connect import check_installed, connect, keep_to_ourselves
from abcd_ns.cluster.dispatcher import Dispatcher
from abcd_ns.cluster.visit_worker import VisitWorker
from abcd_ns.engine.events import WorkerLost, WorkersSeen
from abcd_ns.engine.render.cpu.backend import TorchRasterizer
from abcd_ns.engine.train.training_loop import train
from abcd_ns.errors import UserError
from tests.cluster.conftest import GROWING, make_run
from tests.reference.scenes import equal, listen, whole_scene

os.environ.update(RAY_worker_niceness="0")  # niced, as Ray has it, they starve beside the other tests
keep_to_ourselves(starts=True)  # before Ray is imported
ray = pytest.importorskip("ray")
from ray.cluster_utils import Cluster  # noqa: E402
from ray.exceptions import OutOfDiskError  # noqa: E402

from abcd_ns.cluster import ray_workers  # noqa: E402 - needs Ray
from abcd_ns.cluster.ray_workers import RayWorkers  # noqa: E402

pytestmark = pytest.mark.timeout(240)

TOO_BUSY = ("timed out during startup", "before the timeout")
"""How Ray says that its processes took too long to begin."""
TRAPS = {
    "torch": RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried ..."),
    "cuda": torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB"),
}


def make_worker(setup, photos, seconds: float = 0.0, traps: Path | None = None) -> VisitWorker:
    """In a worker's process.

    Args:
        seconds: that each photo takes, so that visits last.
        traps: a folder; whoever finds a file there takes it away, and raises the error of that name.
    """

    def target(sample):
        time.sleep(seconds)
        for name, error in TRAPS.items() if traps else ():
            with suppress(FileNotFoundError):
                (traps / name).unlink()
                raise error
        return photos.target(sample)

    return VisitWorker(setup, TorchRasterizer(), target)


def refuse():
    raise UserError("the photos are not here")


@pytest.fixture(scope="module")
def traps(tmp_path_factory):
    return tmp_path_factory.mktemp("traps")


@pytest.fixture(scope="module")
def workers(steady, photos, traps):
    """Two real ones on a head of their own, for one run after the other."""
    try:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(ray, "init", partial(ray.init, object_store_memory=100 << 20))
            connect(None, cores=3)
    except WorkersError as error:
        if not any(words in str(error) for words in TOO_BUSY):
            raise
        pytest.skip("this machine is too busy to start Ray, which gives itself 30 s")
    found = RayWorkers(2, partial(make_worker, steady[1], photos, traps=traps))
    yield found
    found.close()
    assert not ray.is_initialized()


@pytest.fixture
def assigned(tmp_path, views, workers):
    """The same run, whose blocks are assigned to them."""
    return assigned_to(workers, tmp_path, views)


def assigned_to(workers: RayWorkers, folder: Path, views) -> Dispatcher:
    """The run that `steady` is of."""
    return make_run(folder, views, lambda _: workers, lag=4, density=GROWING)


def test_two_processes_make_of_a_run_what_one_makes_of_it(steady, assigned, photos):
    seen = listen(assigned, WorkersSeen)
    assigned_first(assigned)
    train(assigned, photos)
    assert equal(whole_scene(assigned), steady[0])
    assert any(all(worker.block is not None for worker in event.workers) for event in seen)
    assert all(worker.visits > 0 and worker.deaths == 0 for worker in assigned.workers.seen())


def test_workers_that_are_lost_take_nothing_along(steady, assigned, photos, traps):
    """One falls silent, as behind a cut cable, one is killed, and one that took their place is out of memory.
    Whatever the silent one may still say counts no more."""
    lost, silent = listen(assigned, WorkerLost), assigned.workers._members[0]
    assigned_first(assigned)
    os.kill(assigned.workers.pids[0], signal.SIGSTOP)
    os.kill(assigned.workers.pids[1], signal.SIGKILL)
    (traps / "torch").touch()
    while silent.question is None:
        time.sleep(0.05)
        assigned.workers._ask()
    silent.asked_at -= ray_workers.SILENCE  # the minute that it has for an answer is over
    train(assigned, photos)
    assert len(lost) == 3
    assert {"silent for 60 s", "out of memory"} < {event.why for event in lost}
    assert not (traps / "torch").exists()
    assert equal(whole_scene(assigned), steady[0])


def test_where_disk_is_full_too_one_line_says_so(assigned, photos, monkeypatch):
    monkeypatch.setattr(ray_workers.ray, "put", Mock(side_effect=OutOfDiskError("no space left on device")))
    with pytest.raises(WorkersError, match=r"no room for a block: no space left.*--object-store-memory"):
        train(assigned, photos)
    assert assigned.state.step == 0


def end(workers: RayWorkers) -> None:
    """End these alone: closing them would end all of Ray."""
    for worker in workers._members:
        ray.kill(worker.actor)


def assigned_first(run: Dispatcher) -> None:
    """Have both workers at it, however long they took to begin."""
    while run.workers.idle < 2:
        run.workers.wait(0.1)
    run._assign()
    assert len(run.state.in_flight) == 2


@pytest.mark.usefixtures("workers")
def test_a_worker_that_cannot_begin_says_why():
    refusing = RayWorkers(1, refuse)
    with pytest.raises(WorkersError, match="worker 1: the photos are not here"):
        refusing.wait(60.0)
    end(refusing)


def test_a_worker_of_another_version_is_refused_in_one_line():
    """Before it reads anything that the other version has made."""
    with pytest.raises(WorkersError, match=r"abcd_ns here is .*, and 0\.0\.9 where.* install the same"):
        ray_workers.Actor().prepare("0.0.9", b"unreadable")


@pytest.mark.usefixtures("workers")
def test_a_visit_that_does_not_fit_a_device_ends_the_run(steady, tmp_path, views, photos, traps):
    """As in one process: nobody else's device would hold it."""
    alone = RayWorkers(1, partial(make_worker, steady[1], photos, traps=traps))
    run = assigned_to(alone, tmp_path, views)
    (traps / "cuda").touch()
    with pytest.raises(torch.cuda.OutOfMemoryError, match=r"Tried to allocate 2\.00 GiB"):
        train(run, photos)
    end(alone)


@pytest.mark.usefixtures("workers")
def test_a_stranger_without_the_token_is_refused():
    address = ray.get_runtime_context().gcs_address
    assert address.startswith("127.0.0.1:")
    code = "import sys; from abcd_ns.cluster.connect import connect; connect(sys.argv[1], cores=1)"
    once = {"RAY_NUM_REDIS_GET_RETRIES": "1"}  # otherwise it tries 20 times, a second apart
    stranger = {**os.environ, **once, "RAY_AUTH_TOKEN": "0" * 64}
    command, folder = [sys.executable, "-c", code, address], Path(__file__).parents[2]
    options = {"env": stranger, "cwd": folder, "timeout": 60, "check": False}
    found = subprocess.run(command, capture_output=True, text=True, **options)
    assert found.returncode != 0
    assert "WorkersError: No Ray cluster answers" in found.stderr


def test_ray_that_was_imported_before_is_not_trusted_to_keep_to_this_machine(monkeypatch):
    monkeypatch.delenv("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER")
    with pytest.raises(WorkersError, match="would listen to strangers: set RAY_ENABLE"):
        keep_to_ourselves(starts=True)


def test_where_ray_is_not_installed_one_line_says_so(monkeypatch):
    monkeypatch.setattr(connecting.importlib.util, "find_spec", lambda _: None)
    with pytest.raises(WorkersError, match=r"pip install 'abcd-ns\[cluster\]'"):
        check_installed()


@pytest.mark.slow
def test_a_machine_that_is_lost_takes_nothing_along(steady, tmp_path, views, photos):
    """Two machines, as Ray sees it, one of which ends: all its processes at once."""
    ray.shutdown()
    system = {"health_check_initial_delay_ms": 0, "health_check_period_ms": 500}
    head = {"num_cpus": 1, "_system_config": {**system, "health_check_failure_threshold": 3}}
    machines = Cluster(initialize_head=True, head_node_args=head)
    try:
        other = machines.add_node(num_cpus=1)
        connect(machines.address, cores=2)
        workers = RayWorkers(2, partial(make_worker, steady[1], photos, 0.01))
        assigned = assigned_to(workers, tmp_path, views)
        assigned_first(assigned)
        machines.remove_node(other, allow_graceful=False)
        train(assigned, photos)
        assert sum(worker.deaths for worker in workers.seen()) > 0
        assert equal(whole_scene(assigned), steady[0])
    finally:
        ray.shutdown()
        machines.shutdown()
