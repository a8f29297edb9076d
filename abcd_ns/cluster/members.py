"""What the driver keeps of each worker, however workers are had."""

import math
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from abcd_ns.cluster.lease import Lease, Workers
from abcd_ns.engine.events import WorkerSeen


@dataclass
class Member:
    """A worker, or the place for one. Moments are of `time.monotonic`."""

    number: int
    lease: Lease | None = None
    """What it is at."""
    done: int = 0
    """Steps of its visit so far."""
    ready: bool = True
    since: float | None = None
    """When it was first ready."""
    free_since: float = 0.0
    waited: float = 0.0
    """Seconds without a block until its last visit began."""
    pid: int = 0
    visits: int = 0
    deaths: int = 0

    @property
    def is_idle(self) -> bool:
        """Whether it could take a visit now."""
        return self.ready and self.lease is None

    def take(self, lease: Lease) -> None:
        """It has a visit."""
        self.waited += time.monotonic() - self.free_since
        self.lease, self.done = lease, 0

    def put_down(self) -> Lease:
        """It has that visit no more."""
        lease, self.lease, self.free_since = self.lease, None, time.monotonic()
        return lease

    def seen(self) -> WorkerSeen:
        """What it is doing, for people."""
        now, visit = time.monotonic(), self.lease and self.lease.task.active
        waited = self.waited + (now - self.free_since if self.is_idle else 0.0)
        share = min(waited / max(now - self.since, 1e-9), 1.0) if self.since else 0.0
        block, steps = (visit.geometry.block, visit.steps) if visit else (None, 0)
        return WorkerSeen(self.number, block, self.done, steps, self.visits, self.deaths, share)


M = TypeVar("M", bound=Member)


class Members(Workers, Generic[M]):
    """All of them, as far as both kinds of workers are alike."""

    def __init__(self, members: Sequence[M]) -> None:
        self._members = list(members)

    @property
    def count(self) -> int:
        return len(self._members)

    @property
    def idle(self) -> int:
        return sum(member.is_idle for member in self._members)

    @property
    def pids(self) -> list[int]:
        """Processes of those that are at work."""
        return [member.pid for member in self._members if member.lease is not None]

    def hold(self) -> bool:
        return not any(member.lease is not None for member in self._members)

    def go_on(self) -> None: ...

    def seen(self) -> Sequence[WorkerSeen]:
        return [member.seen() for member in self._members]

    def _longest_idle(self) -> M:
        return min((m for m in self._members if m.is_idle), key=lambda member: member.free_since)


class RecentMean:
    """Of the last finite numbers; NaN where there is none."""

    def __init__(self) -> None:
        self._last: deque[float] = deque(maxlen=16)

    def add(self, value: float) -> None:
        """One more."""
        if math.isfinite(value):
            self._last.append(value)

    @property
    def value(self) -> float:
        """The mean."""
        return sum(self._last) / len(self._last) if self._last else math.nan
