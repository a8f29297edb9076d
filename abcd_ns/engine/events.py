"""Events that the coordinator announces to its listeners: terminal, viewer, logs. It knows none of them."""

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class VisitBegan:
    """A block was attached; its layers are about to be drawn."""

    visit: int
    epoch: int
    block: int | None
    """None for the warm-up, in which a coarse model of all blocks is trained."""
    steps: int
    views: int
    gaussians: int


@dataclass(frozen=True)
class LayersDrawn:
    """F and B of one more view of the visit are ready; or, where blocks are trained at once, the picture
    that it begins with."""

    visit: int
    done: int
    total: int


@dataclass(frozen=True)
class StepTaken:
    """One optimisation step."""

    step: int
    visit: int
    visit_step: int
    psnr: float
    """Of the crop that was trained on, dB. On an accelerator of the visit's step before, NaN in its first:
    the device is still at work on this one."""


@dataclass(frozen=True)
class VisitEnded:
    """The block is persisted; it is on disk TrainingConfig.commit_seconds later at most."""

    visit: int
    epoch: int
    block: int | None
    gaussians: int
    """In the block, after migration."""
    migrated: int
    """Gaussians that left for other blocks."""
    layer_seconds: float
    """Training time that went into drawing F and B."""
    visit_seconds: float
    """Training time of the whole visit."""


@dataclass(frozen=True)
class EpochEnded:
    """An epoch ended: every observed block was visited once more."""

    epoch: int
    step: int


@dataclass(frozen=True)
class BlockSplit:
    """A block had outgrown its limit and was cut in two, when its visit ended."""

    block: int
    """It keeps its number and one part."""
    new: int
    """The number of the other part."""


@dataclass(frozen=True)
class CutAnew:
    """Growth was over and the scene was cut into fewer blocks, numbered from 0 again."""

    blocks: int


@dataclass(frozen=True)
class Repaired:
    """Something in the active block was wrong and was repaired."""

    visit: int
    block: int | None
    """None for the warm-up, and where all blocks are trained in every step."""
    what: str
    """The count of BlockHealth that it is added to."""
    count: int
    """Gaussians."""


@dataclass(frozen=True)
class WorkerSeen:
    """What one of the run's workers is doing."""

    worker: int
    """From 0."""
    block: int | None
    """In training; None where it waits, or is starting."""
    done: int
    steps: int
    """Of the visit, taken and in all."""
    visits: int
    """That it has finished."""
    deaths: int
    """Times that it was lost and replaced."""
    waited: float
    """Share of its time since it first was ready, 0..1, in which it had no block."""


@dataclass(frozen=True)
class PhotosWanted:
    """Photos of these views, by index, will be asked for soon, in this order: they may be read ahead."""

    views: tuple[int, ...]


@dataclass(frozen=True)
class WorkersSeen:
    """The driver has looked at its workers; it does so about once a second."""

    workers: tuple[WorkerSeen, ...]


@dataclass(frozen=True)
class WorkerLost:
    """A worker is gone, and with it what it was at: the visit is trained again, by another."""

    block: int
    why: str


@dataclass(frozen=True)
class Pruning:
    """The run is complete but for its final pruning, which draws training views again and again."""

    done: int
    total: int
    """Times."""


@dataclass(frozen=True)
class PrunedAtEnd:
    """The final pruning is over."""

    gone: int
    """Gaussians that were taken out."""
    gaussians: int
    """That are left in the whole scene."""
    views: int
    """Training views by which it was judged how many might go."""
    before: float
    """Mean PSNR of these, dB."""
    after: float
    """The same without what is gone."""


@dataclass(frozen=True)
class HeldOutScored:
    """The caller has looked at views that are not trained on; means over them."""

    psnr: float
    """dB."""
    ssim: float | None
    """None where it was not measured."""


Event = (
    VisitBegan
    | LayersDrawn
    | StepTaken
    | VisitEnded
    | EpochEnded
    | BlockSplit
    | CutAnew
    | Repaired
    | PhotosWanted
    | WorkersSeen
    | WorkerLost
    | Pruning
    | PrunedAtEnd
    | HeldOutScored
)
Listener = Callable[[Event], None]


class Announcer:
    """Passes each event to every listener, in the order in which they subscribed."""

    def __init__(self) -> None:
        self._listeners: list[Listener] = []

    def subscribe(self, listener: Listener) -> None:
        """Call `listener` with every event from now on."""
        self._listeners.append(listener)

    def __call__(self, event: Event) -> None:
        """Tell everyone."""
        for listener in self._listeners:
            listener(event)
