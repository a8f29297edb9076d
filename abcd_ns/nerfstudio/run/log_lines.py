"""The lines of a run's log by kind; some are an event of the engine's."""

from collections.abc import Iterable
from dataclasses import dataclass

from abcd_ns.engine.events import (
    CutAnew,
    EpochEnded,
    HeldOutScored,
    PrunedAtEnd,
    VisitBegan,
    VisitEnded,
    WorkerLost,
)

SCHEMA = 2  # raised whenever a line changes its form or meaning


@dataclass(frozen=True)
class Line:
    """What all lines have."""

    step: int  # optimisation steps so far
    seconds: float  # of training so far


@dataclass(frozen=True)
class TrainingLine(Line):
    """Training began, or went on after a resume."""

    schema: int
    blocks: int
    gaussians: int
    limit: int | None  # on the number of Gaussians in the scene
    budgets: dict[str, int]  # limits of what is kept in memory, bytes, by name
    compiled_loss: bool = False  # whether the loss runs in Triton's kernels


@dataclass(frozen=True)
class VisitLine(VisitBegan, Line):
    """A visit began."""


@dataclass(frozen=True)
class SampleLine(Line):
    """Where the run stands, every now and then."""

    psnr: float | None  # mean of training crops since the last sample, dB
    gaussians: int  # in the whole scene
    rss_bytes: int  # RAM of the process
    device_bytes: int | None  # of torch on the CUDA device; None without one
    held: dict[str, int]  # bytes in use of each budget


@dataclass(frozen=True)
class VisitEndLine(VisitEnded, Line):
    """A visit ended and its block is persisted."""

    psnr: float | None  # mean of training crops in the visit's later half, dB


def layer_share(visits: Iterable[VisitEndLine]) -> float:
    """Share of the visits' time that went into layers, 0..1."""
    visits = list(visits)
    return sum(visit.layer_seconds for visit in visits) / max(sum(v.visit_seconds for v in visits), 1e-9)


@dataclass(frozen=True)
class EpochEndLine(EpochEnded, Line):
    """Every block that some view sees was visited once more."""


@dataclass(frozen=True)
class CutAnewLine(CutAnew, Line):
    """The scene was cut into fewer blocks."""


@dataclass(frozen=True)
class PrunedAtEndLine(PrunedAtEnd, Line):
    """The final pruning is over."""


@dataclass(frozen=True)
class WorkerLostLine(WorkerLost, Line):
    """A worker was lost, and its visit is trained again."""


@dataclass(frozen=True)
class WorkerLine(Line):
    """What a worker has done when training ends."""

    worker: int
    visits: int
    deaths: int
    waited: float  # share of its time without a block, 0..1


@dataclass(frozen=True)
class HeldOutLine(HeldOutScored, Line):
    """Means over the held-out views."""

    psnr: float | None  # dB; None where it is not finite


@dataclass(frozen=True)
class EndLine(Line):
    """Training is over."""

    gaussians: int
    peak_rss_bytes: int
    peak_device_bytes: int | None


KINDS: dict[str, type[Line]] = {
    "training": TrainingLine,
    "visit": VisitLine,
    "sample": SampleLine,
    "visit end": VisitEndLine,
    "epoch end": EpochEndLine,
    "cut anew": CutAnewLine,
    "worker lost": WorkerLostLine,
    "worker": WorkerLine,
    "pruned at end": PrunedAtEndLine,
    "held out": HeldOutLine,
    "end": EndLine,
}
"""By the value of a line's field "kind"."""
KIND_OF = {
    VisitBegan: "visit",
    EpochEnded: "epoch end",
    CutAnew: "cut anew",
    WorkerLost: "worker lost",
    PrunedAtEnd: "pruned at end",
}
"""Events of the engine that are lines."""
