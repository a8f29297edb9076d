"""Workers on the cores of this machine: for each visit a process is forked, which trains it and ends.

A fork has everything: options, photos, kernels, and every block as it is at that moment. That works where no
GPU is in use and no thread pool has to be carried over, so a worker computes in a single thread.
"""

import ctypes
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait
from multiprocessing.sharedctypes import RawValue
from typing import NoReturn

import torch

from abcd_ns.cluster.assignment import Assignment, Member, Report, VisitOutcome, Workers, WorkersError
from abcd_ns.cluster.visit_worker import VisitWorker
from abcd_ns.engine.events import Event, StepTaken
from abcd_ns.engine.kernels.native import share_cores
from abcd_ns.errors import UserError, is_out_of_memory
from abcd_ns.machine import end_with_parent

SILENCE = 600.0  # seconds without a word after which a worker counts as lost
FIRST_WORD = 5.0  # seconds in which a process that was just forked says that it lives
TELL_EVERY = 0.5  # seconds between two words of a worker's progress


def can_fork(device: torch.device) -> bool:
    """Whether this machine and this process are made for it: on Linux, without a GPU."""
    return sys.platform == "linux" and device.type == "cpu" and not torch.cuda.is_available()


def last_words(error: Exception) -> WorkersError | MemoryError:
    """Of a worker: MemoryError where another may do better, else WorkersError in one line."""
    if isinstance(error, UserError):
        return WorkersError(str(error))
    if is_out_of_memory(error):
        return MemoryError("out of memory")
    place = traceback.extract_tb(error.__traceback__)[-1]
    where = f"{os.path.basename(place.filename)}:{place.lineno}, in {place.name}"
    what = traceback.format_exception_only(error)[-1].splitlines()[0]
    fix = "What visits have finished is safe; --pipeline.workers 1 trains in one process"
    return WorkersError(f"A process that trains a block failed: {what} ({where}). {fix}.")


@dataclass
class Place(Member):
    """For a visit; its process, while there is one."""

    pipe: Connection | None = None
    heard: float = 0.0  # when it last said something, or was started


class ForkedWorkers(Workers):
    """So many processes at most at a time, in each of which `worker` trains a visit."""

    def __init__(self, count: int, worker: VisitWorker) -> None:
        self._worker, self._owner, now = worker, os.getpid(), time.monotonic()
        self._stood_still = RawValue(ctypes.c_double, 0.0)  # seconds in all; forked processes read it, too
        self._held_since: float | None = None
        super().__init__([Place(number, since=now, free_since=now) for number in range(count)])

    def submit(self, assignment: Assignment) -> None:
        member = self._longest_idle()
        member.take(assignment)
        member.heard = time.monotonic()
        member.pipe, theirs = Pipe()
        member.pid = os.fork()
        if member.pid == 0:
            member.pipe.close()
            visit, task = self._worker.visit, assignment.task
            _live(theirs, lambda tell: visit(task, assignment.state(), assignment.drawn, tell, self._clock))
        theirs.close()
        member.pipe.poll(FIRST_WORD)  # from then on it ends when this process does

    def _clock(self) -> float:
        return time.perf_counter() - self._stood_still.value

    def hold(self) -> bool:
        if self._held_since is None:
            self._held_since = time.perf_counter()
            self._signal(signal.SIGSTOP)
        return True

    def resume(self) -> None:
        if self._held_since is None:
            return
        held, self._held_since = time.perf_counter() - self._held_since, None
        self._stood_still.value += held  # first: the next worker may read the clock at once
        for member in self._members:
            member.heard += held  # nobody was silent: they could not speak
        self._signal(signal.SIGCONT)

    def _signal(self, number: signal.Signals) -> None:
        for pid in self.pids:
            with suppress(ProcessLookupError):
                os.kill(pid, number)

    def wait(self, seconds: float) -> list[Report]:
        busy = {member.pipe: member for member in self._members if member.assignment}
        heard = [self._hear(busy[pipe]) for pipe in wait(list(busy), seconds)]
        reports = [report for report in heard if report is not None]
        for member in busy.values():
            if member.assignment and time.monotonic() - member.heard > SILENCE:
                reports.append(self._lose(member, f"silent for {SILENCE:.0f} s"))
        return reports

    def close(self) -> None:
        for member in self._members:
            if member.assignment:
                self._end(member)

    def _hear(self, member: Place) -> Report | None:
        member.heard = time.monotonic()
        try:
            said = member.pipe.recv()
        except (OSError, EOFError):
            return self._lose(member, "it was killed")
        match said:
            case None:  # it lives
                return None
            case (done, _):
                member.done = done
                return Report(member.assignment.number, said)
            case VisitOutcome():
                member.visits += 1
                return Report(self._end(member).number, said)
            case MemoryError():
                return self._lose(member, str(said))
        self._end(member)
        raise said

    def _lose(self, member: Place, why: str) -> Report:
        member.deaths += 1
        return Report(self._end(member).number, why)

    def _end(self, member: Place) -> Assignment:
        assignment = member.put_down()
        member.pipe.close()
        if os.getpid() == self._owner:  # a process that was forked meanwhile knows it, too
            with suppress(ProcessLookupError):
                os.kill(member.pid, signal.SIGKILL)
            with suppress(ChildProcessError):
                os.waitpid(member.pid, 0)
        return assignment


def _live(pipe: Connection, visit: Callable[[Callable[[Event], None]], VisitOutcome]) -> NoReturn:
    """All that a worker's process does. Any error ends it, after it was reported."""
    status, told = 1, time.monotonic()

    def tell(event: Event) -> None:
        """How far the visit is, now and then; before its first step, that it goes on."""
        nonlocal told
        if time.monotonic() - told >= TELL_EVERY:
            told = time.monotonic()
            pipe.send((event.visit_step, event.psnr) if isinstance(event, StepTaken) else None)

    try:
        end_with_parent()
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches both; the training process decides
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        pipe.send(None)
        share_cores(1)
        pipe.send(visit(tell))
        status = 0
    except Exception as error:
        with suppress(OSError):
            pipe.send(last_words(error))
        raise
    finally:
        os._exit(status)  # none of the training process' own exits and handlers
