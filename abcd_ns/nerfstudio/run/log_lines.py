"""The lines of a run's log: what each kind of them says; some are an event of the engine's."""

from collections.abc import Iterable
from dataclasses import dataclass

from abcd_ns.engine.events import EpochEnded, PrunedAtEnd, VisitBegan, WorkerLost

SCHEMA = 2
"""Raised whenever a line changes its form or meaning."""


@dataclass(frozen=True)
class Line:
    """What all lines say."""

    step: int
    """Optimisation steps taken by then."""
    seconds: float
    """Of training by then."""


@dataclass(frozen=True)
class TrainingLine(Line):
    """Training began, or went on after a resume."""

    schema: int
    blocks: int
    gaussians: int
    limit: int | None
    """On the number of Gaussians in the scene."""
    budgets: dict[str, int]
    """Limits of what is kept at hand, bytes, by name."""
    compiled_loss: bool = False
    """Whether the loss runs in Triton's kernels."""


@dataclass(frozen=True)
class VisitLine(VisitBegan, Line):
    """A visit began."""


@dataclass(frozen=True)
class SampleLine(Line):
    """How things stand; written every now and then."""

    psnr: float | None
    """Mean over the steps since the last sample, of the crops that were trained on, dB."""
    gaussians: int
    """In the whole scene."""
    rss_bytes: int
    """RAM of the process."""
    device_bytes: int | None
    """That torch has given out on the CUDA device; None without one."""
    held: dict[str, int]
    """Of each budget, what is in use, bytes."""


@dataclass(frozen=True)
class VisitEndLine(Line):
    """A visit ended and its block is persisted."""

    visit: int
    epoch: int
    block: int | None
    gaussians: int
    """In the block, after migration."""
    migrated: int
    """Gaussians that left for other blocks."""
    layer_seconds: float
    visit_seconds: float
    psnr: float | None
    """Mean over the visit's later half, of the crops that were trained on, dB."""


def layer_share(visits: Iterable[VisitEndLine]) -> float:
    """Share of the visits' time that went into layers, 0..1: one number for terminal, log and report."""
    visits = list(visits)
    return sum(visit.layer_seconds for visit in visits) / max(sum(v.visit_seconds for v in visits), 1e-9)


@dataclass(frozen=True)
class EpochEndLine(EpochEnded, Line):
    """Every block that some view sees was visited once more."""


@dataclass(frozen=True)
class PrunedAtEndLine(PrunedAtEnd, Line):
    """The run was complete, and what its pictures hardly miss was taken out."""


@dataclass(frozen=True)
class WorkerLostLine(WorkerLost, Line):
    """A worker was lost, and the visit it was at is trained again."""


@dataclass(frozen=True)
class WorkerLine(Line):
    """What a worker has done when training ends."""

    worker: int
    visits: int
    deaths: int
    waited: float
    """Share of its time without a block, 0..1."""


@dataclass(frozen=True)
class HeldOutLine(Line):
    """The held-out views were looked at; means over them."""

    psnr: float | None
    """dB; None where it is not finite."""
    ssim: float | None


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
    WorkerLost: "worker lost",
    PrunedAtEnd: "pruned at end",
}
"""By what of the engine's events is a line as it is."""
