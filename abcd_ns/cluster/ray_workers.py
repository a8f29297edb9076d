"""Workers as Ray actors, on this machine or on those of a cluster.

Ray carries blocks and answers, and nothing of a run lives in it: a worker that is lost is replaced by a new
one, and what it was at is given to another. The driver owns every object, so the end of a worker takes none.
"""

import math
import os
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import ray
import torch
from ray import cloudpickle
from ray import exceptions as of_ray

from abcd_ns import __version__
from abcd_ns.cluster.assignment import (
    Assignment,
    Member,
    Report,
    VisitOutcome,
    VisitTask,
    Workers,
    WorkersError,
)
from abcd_ns.cluster.visit_worker import VisitWorker
from abcd_ns.engine.events import Event, StepTaken
from abcd_ns.engine.gaussians.block_state import BlockState, Packed
from abcd_ns.engine.kernels.native import share_cores
from abcd_ns.engine.types import Gaussians
from abcd_ns.errors import UserError, first_line, is_out_of_memory
from abcd_ns.machine import own_commit

SILENCE, SLOW_START = 60.0, 600.0  # seconds until a worker that is silent, or never begins, is lost
LOOK_EVERY = 1.0  # seconds between two questions
STARTS = 3  # workers in a row that may end before they are ready
FULL = (of_ray.ObjectStoreFullError, of_ray.OutOfDiskError)


@dataclass(frozen=True)
class Shared:
    """Gaussians or a block in Ray's object store: calling it reads them; here without a copy."""

    ref: ray.ObjectRef
    meta: dict[str, Any] | None  # of a block; None for Gaussians

    @staticmethod
    def of(value: Gaussians | BlockState) -> "Shared":
        """Put it there; the caller owns it. WorkersError says that memory and disk are full."""
        tensors, meta = (dict(value.items()), None) if isinstance(value, Gaussians) else value.packed()
        try:
            return Shared(ray.put({name: tensor.numpy() for name, tensor in tensors.items()}), meta)
        except FULL as error:
            raise _no_room(error) from error

    def __call__(self) -> Gaussians | BlockState:
        """Read it; not to be written to."""
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "The given NumPy array is not writable")
            tensors = {name: torch.from_numpy(array) for name, array in ray.get(self.ref).items()}
        return Gaussians(**tensors) if self.meta is None else BlockState.unpacked(Packed(tensors, self.meta))


class Actor:
    """A worker's process. One thread trains; another answers how far it is."""

    def __init__(self) -> None:
        self._worker: VisitWorker | None = None
        self._seen = 0, math.nan

    def prepare(self, version: str, make: bytes) -> int:
        """Read what the run needs; gives the process' identifier. `version` is of abcd_ns where the run was
        started. `make` is pickled: another version may not even read it."""
        if version != (own := _version()):
            same = "install the same on all machines"
            raise WorkersError(f"abcd_ns here is {own}, and {version} where the run was started: {same}.")
        share_cores(int(os.environ.get("OMP_NUM_THREADS", "1")))
        self._worker = cloudpickle.loads(make)()
        return os.getpid()

    def visit(self, task: VisitTask, state: Shared, drawn: dict[int, Shared]) -> VisitOutcome:
        self._seen = 0, math.nan
        return self._worker.visit(task, state(), drawn, self._hear)

    def _hear(self, event: Event) -> None:
        if isinstance(event, StepTaken):
            self._seen = event.visit_step, event.psnr

    def progress(self) -> tuple[int, float]:
        """Steps of the visit so far, and the PSNR of the last one, dB."""
        return self._seen


@dataclass
class Remote(Member):
    """A worker on some machine."""

    actor: Any = None
    asked: ray.ObjectRef | None = None  # what it is at: getting ready, or a visit
    question: ray.ObjectRef | None = None
    asked_at: float = 0.0  # when its last question was put, or it was started


class RayWorkers(Workers):
    """So many actors of the Ray cluster that this process is connected to, each with `gpus` GPUs, 1 or 0, and
    `cores`. `make`, which is pickled, is called in each worker's process and reads what the run needs."""

    def __init__(self, count: int, make: Callable[[], VisitWorker], *, gpus: int = 0, cores: int = 1) -> None:
        options = {"num_gpus": gpus, "num_cpus": cores, "max_concurrency": 2}
        self._class = ray.remote(**options, max_restarts=0, max_task_retries=0)(Actor)
        self._make = ray.put(cloudpickle.dumps(make))
        self._failed_starts = 0
        super().__init__([self._start(Remote(number)) for number in range(count)])

    share = staticmethod(Shared.of)

    def submit(self, assignment: Assignment) -> None:
        member = self._longest_idle()
        member.take(assignment)
        member.asked_at = time.monotonic()
        member.asked = member.actor.visit.remote(assignment.task, assignment.state, dict(assignment.drawn))

    def wait(self, seconds: float) -> list[Report]:
        self._ask()
        by_ref = {ref: member for member in self._members for ref in (member.asked, member.question) if ref}
        if not by_ref:
            return []
        ray.wait(list(by_ref), timeout=seconds)
        answered, _ = ray.wait(list(by_ref), num_returns=len(by_ref), timeout=0)
        reports: list[Report] = []
        for ref in answered:
            if ref == by_ref[ref].question:
                reports += self._answer_of(by_ref[ref])
            elif ref == by_ref[ref].asked:
                reports += self._end_of(by_ref[ref])
        for member in self._members:
            patience = SILENCE if member.ready else SLOW_START
            waits = member.question is not None or not member.ready
            if waits and time.monotonic() - member.asked_at > patience:
                reports += self._replace(member, f"silent for {patience:.0f} s")
        return reports

    def close(self) -> None:
        for member in self._members if ray.is_initialized() else []:
            ray.kill(member.actor)
        self._members = []
        ray.shutdown()

    def _start(self, member: Remote) -> Remote:
        member.actor = self._class.remote()
        member.asked = member.actor.prepare.remote(_version(), self._make)
        member.question, member.assignment, member.ready = None, None, False
        member.asked_at = member.free_since = time.monotonic()
        return member

    def _ask(self) -> None:
        now = time.monotonic()
        for member in self._members:
            is_due = member.question is None and now - member.asked_at > LOOK_EVERY
            if member.assignment and is_due:
                member.question, member.asked_at = member.actor.progress.remote(), now

    def _answer_of(self, member: Remote) -> list[Report]:
        question, member.question = member.question, None
        try:
            progress = ray.get(question, timeout=0)
        except (of_ray.RayActorError, of_ray.GetTimeoutError):
            return []  # what it was asked to do fails likewise, and says why
        if member.assignment is None:
            return []
        member.done, _ = progress
        return [Report(member.assignment.number, progress)]

    def _end_of(self, member: Remote) -> list[Report]:
        try:
            answer = ray.get(member.asked)
        except of_ray.RayTaskError as error:
            if is_out_of_memory(error.cause):  # as if the kernel had killed it: a new one begins with none
                return self._replace(member, "out of memory")
            raise _as_user_error(error, member.number) from error
        except of_ray.RayError as error:
            return self._replace(member, first_line(error))
        member.asked, assignment = None, member.put_down()
        if not member.ready:
            member.ready, member.pid, self._failed_starts = True, answer, 0
            member.since = member.since or member.free_since
            return []
        member.visits += 1
        return [Report(assignment.number, answer)]

    def _replace(self, member: Remote, why: str) -> list[Report]:
        """End one, if it is not gone, and start another in its place."""
        ray.kill(member.actor)
        lost = [Report(member.assignment.number, why)] if member.assignment else []
        member.deaths += 1
        self._failed_starts += not member.ready
        if self._failed_starts >= STARTS:
            fix = "Try with fewer workers; abcd doctor looks at this machine"
            raise WorkersError(f"Workers end before they can begin, the last one so: {why}. {fix}.")
        self._start(member)
        return lost


def _version() -> str:
    return " at ".join(filter(None, (__version__, own_commit())))


def _no_room(error: Exception) -> WorkersError:
    free = "Free the disk of Ray's folder (RAY_TMPDIR says where)"
    fix = f"{free}, or start a cluster with a larger --object-store-memory"
    return WorkersError(f"Ray has no room for a block: {first_line(error)}. {fix}.")


def _as_user_error(error: of_ray.RayTaskError, number: int) -> Exception:
    """What a worker raised, as it would have been raised here."""
    cause = error.cause
    if isinstance(cause, UserError):
        return WorkersError(f"worker {number + 1}: {cause}")
    if isinstance(cause, FULL):
        return _no_room(cause)
    return cause if isinstance(cause, torch.cuda.OutOfMemoryError) else error
