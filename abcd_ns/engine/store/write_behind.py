"""Writes to a store beside the training: snapshots of a run, each whole, one after the other.

A daemon thread does it, which lives as long as there is something to write.

Processes that train a block are forked from this one, and a thread does not live on in a fork. So a fork
waits until the thread is between two writes, and holds the lock: no write is ever cut in two. The child
writes nothing and reads no store: it has all blocks.
"""

import math
import os
import threading
import time
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from abcd_ns.engine.gaussians.block_state import Packed
from abcd_ns.engine.store import ParameterStore
from abcd_ns.engine.store.special_blocks import BlockName


@dataclass(frozen=True)
class Snapshot:
    """What a commit brings: everything as it was at one moment between two steps. Nobody changes it."""

    blocks: dict[BlockName, Packed]  # those that have changed, and tables of the run's
    header: dict[str, Any] | None  # None where it has not changed
    state: dict[str, Any]  # the run's, as JSON

    def after(self, earlier: "Snapshot | None") -> "Snapshot":
        """Both as one commit."""
        if earlier is None:
            return self
        header = earlier.header if self.header is None else self.header
        return Snapshot({**earlier.blocks, **self.blocks}, header, self.state)


class WriteBehind:
    """At most one snapshot is being written and one waits, which later ones are added to. `written` is called
    with each that has become durable, on the thread, without the lock."""

    def __init__(self, store: ParameterStore, written: Callable[[Snapshot], None]) -> None:
        self._store, self._written = store, written
        self.mutex = threading.RLock()
        """Guards all of this, and data that callers share with jobs. It must not be held in a fork. An
        exception may break off the viewer's pictures in any line of Python: none of them releases it."""
        self.lock = threading.Condition(self.mutex)
        """The same, to wait with, for threads that nothing breaks off."""
        self._waiting: Snapshot | None = None
        self._due, self._began = math.inf, time.monotonic()
        self._error: BaseException | None = None
        self.busy = False
        """Whether a snapshot is being written."""
        self._thread: threading.Thread | None = None
        _all.add(self)

    def put(self, snapshot: Snapshot, within: float) -> None:
        """Write it, with what waits already, so many seconds after the last write began."""
        with self.lock:
            self._waiting = snapshot.after(self._waiting)
            self._due = min(self._due, self._began + within)
            self._wake()

    def check(self) -> None:
        """Raise the error of the last write, if it failed. Nothing of it is lost: it waits for the next."""
        with self.lock:
            error, self._error = self._error, None
            if error is not None:
                raise error

    def flush(self) -> None:
        """Return when all that waits is durable; what failed is tried again. Raises as `check`."""
        with self.lock:
            self._error = None
            if self._waiting is not None:
                self._due = -math.inf
                self._wake()
            while self._error is None and (self._waiting is not None or self.busy):
                self.lock.wait()
            self.check()

    def _wake(self) -> None:
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="store", daemon=True)
            self._thread.start()
        self.lock.notify_all()

    def _run(self) -> None:
        while (snapshot := self._next()) is not None:
            try:
                self._write(snapshot)
            finally:
                del snapshot  # what was written need not stay until there is another
                with self.lock:
                    self.busy = False
                    self.lock.notify_all()

    def _next(self) -> Snapshot | None:
        """What is to be written next, when its time comes. None ends the thread."""
        with self.lock:
            while self._waiting is not None and (left := self._due - time.monotonic()) < math.inf:
                if left > 0:
                    self.lock.wait(left)
                    continue
                snapshot, self._waiting = self._waiting, None
                self._due, self._began, self.busy = math.inf, time.monotonic(), True
                return snapshot
            self._thread = None
            return None

    def _write(self, snapshot: Snapshot) -> None:
        try:
            self._store.commit(snapshot.blocks, header=snapshot.header, state=snapshot.state)
            self._written(snapshot)
        except BaseException as error:  # whatever it is, it is for the thread that trains
            with self.lock:
                self._waiting = snapshot if self._waiting is None else self._waiting.after(snapshot)
                self._due, self._error = math.inf, error
            if not isinstance(error, Exception):
                raise


_all: "weakref.WeakSet[WriteBehind]" = weakref.WeakSet()
_held: list[WriteBehind] = []


def _before_fork() -> None:
    for writer in sorted(_all, key=id):  # two threads that fork take the locks in the same order
        writer.lock.acquire()
        while writer.busy:
            writer.lock.wait()
        _held.append(writer)


def _after_fork() -> None:
    while _held:
        _held.pop().lock.release()


os.register_at_fork(before=_before_fork, after_in_parent=_after_fork, after_in_child=_after_fork)
