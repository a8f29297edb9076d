"""What passes between the one who lends blocks and those who train them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from abcd_ns.engine.events import WorkerSeen
from abcd_ns.engine.gaussians.block_state import BlockState
from abcd_ns.engine.gaussians.packed import Packed
from abcd_ns.engine.space.tree import BlockTree
from abcd_ns.engine.store.lent_scene import Outlines
from abcd_ns.engine.train.health_record import BlockHealth
from abcd_ns.engine.train.run_state import ActiveVisit
from abcd_ns.engine.types import Gaussians
from abcd_ns.errors import UserError


class WorkersError(UserError):
    """Workers cannot be had, or are lost again and again; the message says what to do."""


@dataclass(frozen=True)
class VisitTask:
    """All that decides what a visit makes of its block, besides Gaussians: whoever trains it, and however
    often, comes to the same."""

    active: ActiveVisit
    tree: BlockTree
    outlines: Outlines
    """Of all blocks, at the moment they are lent."""
    step: int
    """Steps of the run before the visit's first one."""
    seconds: float
    """Training time when it begins."""
    sweep: int
    health: BlockHealth
    light: dict[int, Tensor]
    """By view in use, its transform, on the CPU; the worker applies it and leaves it as it is. Empty for none
    at all."""
    poses: dict[str, str]
    """As in RunState; likewise."""
    beside: dict[int, float]
    """By view that shows them, which part of the other blocks' weight is out at the same time; see
    shared_residual."""
    allowance: int | None
    """Gaussians by which the block may grow, for the sake of a limit on the scene; None for any number."""


@dataclass(frozen=True)
class VisitOutcome:
    """What became of a block."""

    state: BlockState
    """On the CPU; Gaussians that left the cell are still among them."""
    done: int
    """Steps taken."""
    """Gaussians of the block and around it, when the visit began."""
    shown: dict[int, float]
    """The influence that the block has on views that were doubtful."""
    health: BlockHealth
    layer_seconds: float


@dataclass(frozen=True)
class Parcel:
    """An outcome on its way between processes: its tensors as arrays, which pickle hands over as they are."""

    outcome: VisitOutcome
    """Without its Gaussians."""
    arrays: dict[str, np.ndarray]
    meta: dict[str, Any]

    @staticmethod
    def of(outcome: VisitOutcome) -> "Parcel":
        """Pack it; no memory is copied."""
        tensors, meta = outcome.state.packed()
        arrays = {name: tensor.numpy() for name, tensor in tensors.items()}
        return Parcel(replace(outcome, state=outcome.state.nobody), arrays, meta)

    def opened(self) -> VisitOutcome:
        """What was packed, in memory of its own: that of the parcel is for passing on."""
        tensors = {name: torch.tensor(array) for name, array in self.arrays.items()}
        return replace(self.outcome, state=BlockState.unpacked(Packed(tensors, self.meta)))


@dataclass(frozen=True)
class Lease:
    """A visit in the hands of a worker. It ends when the worker answers, or is given up."""

    number: int
    """No other lease of the run has it: an answer to one that was given up is known by that."""
    task: VisitTask
    state: Callable[[], BlockState]
    """Reads what the visit begins with, wherever the worker is."""
    drawn: Mapping[int, Callable[[], Gaussians]]
    """Likewise all blocks, this one too, as others draw them."""


@dataclass(frozen=True)
class StepsSeen:
    """A worker is at it."""

    lease: int
    done: int
    psnr: float
    """Of recent steps, dB."""


@dataclass(frozen=True)
class Finished:
    """A worker has answered."""

    lease: int
    outcome: VisitOutcome


@dataclass(frozen=True)
class Lost:
    """A worker is gone, or too long silent, and with it what it was at."""

    lease: int
    why: str


Report = StepsSeen | Finished | Lost


class Workers(Protocol):
    """Those who train visits."""

    @property
    def count(self) -> int:
        """How many there are, those that are starting included."""

    @property
    def idle(self) -> int:
        """How many could take a visit now."""

    def share(self, value: Gaussians | BlockState) -> Callable[[], Gaussians | BlockState]:
        """What reads this wherever a worker is, as long as the caller keeps it."""

    def submit(self, lease: Lease) -> None:
        """Give a visit to one that is idle."""

    def hold(self) -> bool:
        """Let those that are at work stand still; whether that can be done. Harmless when done twice."""

    def go_on(self) -> None:
        """Let those that stand still go on; to be called before anybody is waited for, or given a visit."""

    def wait(self, seconds: float) -> list[Report]:
        """What has happened, in order; waits for something so long at most.

        Raises:
            WorkersError: a worker cannot do what it was asked, and no other could.
        """

    def seen(self) -> Sequence[WorkerSeen]:
        """What each is doing."""

    def close(self) -> None:
        """End them. Harmless when done twice."""
