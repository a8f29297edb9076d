"""What passes between the dispatcher, which assigns blocks, and its workers."""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from abcd_ns.engine.events import WorkerSeen
from abcd_ns.engine.gaussians.block_state import BlockState, Packed
from abcd_ns.engine.space.tree import BlockTree, Box
from abcd_ns.engine.train.run_state import ActiveVisit, BlockHealth
from abcd_ns.engine.types import Gaussians
from abcd_ns.errors import UserError

Drawn = Mapping[int, Callable[[], Gaussians]]  # by block, what reads its Gaussians as others draw them


class WorkersError(UserError):
    """Workers cannot be had, or are lost again and again; the message says what to do."""


@dataclass(frozen=True)
class VisitTask:
    """All that decides what a visit makes of its block, besides Gaussians."""

    active: ActiveVisit
    tree: BlockTree
    counts: list[int]
    bounds: list[Box | None]  # see BlockScene; of all blocks, as the visit is assigned
    step: int  # steps of the run before the visit's first one
    seconds: float  # training time when it begins
    epoch: int
    health: BlockHealth
    light: dict[int, Tensor]  # by view in use, its transform, on the CPU; empty without any
    poses: dict[int, bytes]  # as in RunState; likewise
    beside: dict[int, float]  # see `shown_beside`
    allowance: int | None  # Gaussians by which the block may grow; None for any number


@dataclass(frozen=True)
class VisitOutcome:
    """What became of a block."""

    state: BlockState  # on the CPU; Gaussians that left the cell are still among them
    done: int  # steps taken
    shown: dict[int, float]  # the influence that the block has on views that were doubtful
    health: BlockHealth
    layer_seconds: float

    def __getstate__(self) -> dict[str, Any]:
        tensors, meta = self.state.packed()
        arrays = {name: tensor.numpy() for name, tensor in tensors.items()}  # pickle does not copy these
        return {**vars(self), "state": (arrays, meta)}

    def __setstate__(self, fields: dict[str, Any]) -> None:
        arrays, meta = fields["state"]
        tensors = {name: torch.tensor(array) for name, array in arrays.items()}  # in memory of their own
        vars(self).update({**fields, "state": BlockState.unpacked(Packed(tensors, meta))})


@dataclass
class Assignment:
    """A visit that was begun and is not taken in yet. A worker has it if it was `submitted`."""

    number: int  # no other one of the run has it, so that late answers are known
    task: VisitTask
    state: Callable[[], BlockState]  # reads what the visit begins with, wherever the worker is
    drawn: Drawn  # likewise all blocks, this one too
    taken: int  # Gaussians that waited for the block and are in its visit
    ends: int  # views that each place for a visit has been given to draw when this one is to end
    submitted: bool = False
    losses: int = 0
    outcome: VisitOutcome | None = None


class Report(NamedTuple):
    """What is heard of an assignment."""

    assignment: int
    said: tuple[int, float] | VisitOutcome | str
    """Steps taken and the last one's PSNR, dB; or what became of the visit; or why the worker is lost."""


@dataclass
class Member:
    """A worker, or the place for one. Times are of `time.monotonic`."""

    number: int
    assignment: Assignment | None = None
    done: int = 0  # steps of its visit so far
    ready: bool = True
    since: float | None = None  # when it was first ready
    free_since: float = 0.0
    waited: float = 0.0  # seconds without a block until its last visit began
    pid: int = 0
    visits: int = 0
    deaths: int = 0

    @property
    def is_idle(self) -> bool:
        return self.ready and self.assignment is None

    def take(self, assignment: Assignment) -> None:
        self.waited += time.monotonic() - self.free_since
        self.assignment, self.done = assignment, 0

    def put_down(self) -> Assignment:
        """End the visit, whatever became of it."""
        assignment, self.assignment, self.free_since = self.assignment, None, time.monotonic()
        return assignment

    def seen(self) -> WorkerSeen:
        now, visit = time.monotonic(), self.assignment and self.assignment.task.active
        waited = self.waited + (now - self.free_since if self.is_idle else 0.0)
        share = min(waited / max(now - self.since, 1e-9), 1.0) if self.since else 0.0
        block, steps = (visit.geometry.block, visit.steps) if visit else (None, 0)
        return WorkerSeen(self.number, block, self.done, steps, self.visits, self.deaths, share)


class Workers(ABC):
    """Those that train visits."""

    def __init__(self, members: list[Member]) -> None:
        self._members = members

    @property
    def count(self) -> int:
        """How many there are, those that are starting included."""
        return len(self._members)

    @property
    def idle(self) -> int:
        """How many could take a visit now."""
        return sum(member.is_idle for member in self._members)

    @property
    def pids(self) -> list[int]:
        """Processes of those that train."""
        return [member.pid for member in self._members if member.assignment]

    def share(self, value: Gaussians | BlockState) -> Callable[[], Gaussians | BlockState]:
        """What reads this wherever a worker is, as long as the caller keeps it."""
        return lambda: value  # what is stored never changes

    @abstractmethod
    def submit(self, assignment: Assignment) -> None:
        """Give a visit to the one that has been idle for longest."""

    def hold(self) -> bool:
        """Stop those that train; whether that can be done. Harmless when done twice."""
        return not any(member.assignment for member in self._members)

    def resume(self) -> None:  # noqa: B027 - some stop nobody
        """Let those that were stopped continue; to be called before `wait` and `submit`."""

    @abstractmethod
    def wait(self, seconds: float) -> list[Report]:
        """What has happened, in order; waits `seconds` at most. WorkersError says what no worker could do."""

    def seen(self) -> Sequence[WorkerSeen]:
        return [member.seen() for member in self._members]

    @abstractmethod
    def close(self) -> None:
        """End them. Harmless when done twice."""

    def _longest_idle(self) -> Any:
        return min((m for m in self._members if m.is_idle), key=lambda member: member.free_since)
