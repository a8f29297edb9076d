"""A process forked from this one, which draws shares of steps as this one would.

Forking hands over everything: scene, views, photos, kernels. That works where no GPU is in use and no thread
pool has to be carried over, so the helper computes in a single thread.
"""

import ctypes
import os
import signal
import sys
import traceback
import weakref
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any, NoReturn

import numpy as np
import torch

from abcd_ns.engine.train.density.control import COUNTED
from abcd_ns.engine.train.step.workers.share import Contribution, DrawShare, Task
from abcd_ns.engine.train.step.workers.shared_memory import SharedRows
from abcd_ns.engine.types import PARAM_NAMES, Gaussians
from abcd_ns.errors import UserError, is_out_of_memory

PATIENCE = 600.0
"""Seconds without an answer after which a helper counts as lost."""
PR_SET_PDEATHSIG = 1
"""Of Linux' prctl: a signal for this process when its parent ends, however that ends."""


Given = tuple[bool, list[tuple[int, np.ndarray]]]
"""Whether there were counts, and the gradients of the pictures' transforms."""


class HelperError(UserError):
    """Something went wrong in a helper that was not lost; the message says what and where."""


@dataclass(frozen=True)
class Failed:
    """A helper's last words."""

    why: str

    @staticmethod
    def of(error: Exception) -> "Failed":
        """What the user can mend as it is; of all else, one line of the traceback's end."""
        if isinstance(error, UserError):
            return Failed(str(error))
        place = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{os.path.basename(place.filename)}:{place.lineno}, in {place.name}"
        what = traceback.format_exception_only(error)[-1].splitlines()[0]
        return Failed(
            f"A process that shares steps failed: {what} ({where}). What visits have finished is safe; "
            "--pipeline.training.processes 1 does without."
        )


class Room:
    """What processes share: the block's parameters, and for one helper what it gives back.

    Args:
        params: written by the training process, read by all helpers.
        rows: Gaussians at most.
    """

    def __init__(self, params: SharedRows, like: Gaussians, rows: int) -> None:
        self.params = params
        self.gradients = SharedRows.like(like, rows)
        self.counts = SharedRows(dict.fromkeys(COUNTED, ()), rows)

    def give(self, part: Contribution) -> Given:
        """Write what a share adds, but for what is small."""
        self.gradients.write(part.gradients)
        self.counts.write(part.counts)
        return bool(part.counts), [(view, gradient.numpy()) for view, gradient in part.lights]

    def take(self, rows: int, given: Given) -> Contribution:
        """Read it: shared memory, to be used before the next step."""
        gradients = {name: self.gradients.rows(name, rows) for name in PARAM_NAMES}
        counted, lights = given
        counts = {name: self.counts.rows(name, rows) for name in COUNTED} if counted else {}
        return Contribution(gradients, counts, [(view, torch.from_numpy(values)) for view, values in lights])

    def leaves(self, rows: int) -> Gaussians:
        """The parameters, to be differentiated by."""
        names = PARAM_NAMES
        return Gaussians(**{n: self.params.rows(n, rows).clone().requires_grad_() for n in names})


class HelperProcess:
    """A helper, as the process sees it that forked it.

    Args:
        begin: called in the new process; gives what draws its shares.
    """

    def __init__(self, room: Room, begin: Callable[[], DrawShare]) -> None:
        self._room = room
        self._pipe, theirs = Pipe()
        self.pid = os.fork()
        """Its identifier."""
        if self.pid == 0:
            self._pipe.close()
            _live(theirs, begin, room)
        theirs.close()
        self._ends = weakref.finalize(self, _end, os.getpid(), self.pid)

    def ask(self, rows: int, task: Task) -> None:
        """Let it begin a step, on the parameters that are in the room."""
        with suppress(OSError):  # then no answer will come
            self._pipe.send((rows, task))

    def answer(self) -> Any | None:
        """The next thing that it says: Drawn, then Given. None if it is lost.

        Raises:
            HelperError: something went wrong in it.
        """
        found = None
        with suppress(OSError, EOFError):
            if self._pipe.poll(PATIENCE):
                found = self._pipe.recv()
        if isinstance(found, Failed):
            raise HelperError(found.why)
        return found

    def end(self) -> None:
        """Kill it. Harmless when it has ended."""
        self._ends()
        self._pipe.close()


def can_fork(device: torch.device) -> bool:
    """Whether this machine and this process are made for it: on Linux, without a GPU."""
    return sys.platform == "linux" and device.type == "cpu" and not torch.cuda.is_available()


def _end(parent: int, pid: int) -> None:
    if os.getpid() != parent:  # a helper that was forked later knows it, too
        return
    with suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)
    with suppress(ChildProcessError):
        os.waitpid(pid, 0)


def _live(pipe: Connection, begin: Callable[[], DrawShare], room: Room) -> NoReturn:
    """All of a helper's life. Whatever goes wrong in it ends it. Who waits for it is told, and does the work
    if it was killed or had no memory."""
    status = 1
    try:
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches both; the training process decides
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        torch.set_num_threads(1)
        _serve(pipe, room, begin())
        status = 0
    except Exception as error:
        if not is_out_of_memory(error):
            pipe.send(Failed.of(error))
        raise
    finally:
        os._exit(status)  # none of the training process' own exits and handlers


def _serve(pipe: Connection, room: Room, draw: DrawShare) -> None:
    with suppress(EOFError):
        while True:
            rows, task = pipe.recv()
            share = draw(room.leaves(rows), task)
            pipe.send(share.drawn)
            pipe.send(room.give(share.differentiate()))
