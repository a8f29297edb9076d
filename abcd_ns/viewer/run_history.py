"""What the panel knows of a run: pure functions of the coordinator's events and state."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

from abcd_ns.engine.events import BlockSplit, Event, StepTaken, VisitBegan, VisitEnded
from abcd_ns.engine.train.health_record import TOO_FEW_VIEWS
from abcd_ns.engine.train.run_state import RunState
from abcd_ns.engine.train.step.final_pruning import FEWEST, MOST, RANKING, ROUNDS, STEPS_EACH
from abcd_ns.engine.train.trainer import Trainer

SECONDS_BETWEEN_POINTS = 2.0
"""Of the curve, where visits are shorter, longer or do not exist."""
FORWARD = 0.5
"""Time of drawing a picture, in steps, which draw it backward, too."""
MOST_POINTS = 400
"""Of the curve; then every second one goes."""


class Status(str, Enum):
    """Of a block; the values are the panel's words."""

    UNTRAINED = "untrained"
    WARM_UP = "warm-up"
    ACTIVE = "active"
    DONE = "done"
    UNDER_OBSERVED = "under-observed"


@dataclass(frozen=True)
class BlockRow:
    """A line of the table of blocks."""

    block: int
    status: Status
    gaussians: int | None
    """None while a coarse model of all blocks is trained."""
    psnr: float | None
    """Mean over the crops of its last visit, dB."""
    views: int | None
    """Worth training it on; None while that is unknown."""


@dataclass
class RunHistory:
    """Follows a run, event by event."""

    visits: dict[int, int] = field(default_factory=dict)
    """By block, how many are over."""
    psnr: dict[int, float] = field(default_factory=dict)
    curve: list[tuple[float, float]] = field(default_factory=list)
    """(seconds of training, mean PSNR of the crops since the last point)."""
    under_way: dict[int, VisitBegan] = field(default_factory=dict)
    """Visits, by number; several where workers train."""
    _crops: dict[int, list[float]] = field(default_factory=dict)
    """By visit that is under way, the PSNR of its steps."""
    _recent: list[float] = field(default_factory=list)
    """PSNR of the steps since the last point of the curve."""

    @staticmethod
    def resumed(state: RunState) -> "RunHistory":
        """Of a run that goes on: which blocks had a visit follows from what their health tells."""
        known = state.health.items()
        history = RunHistory({b: of.visits for b, of in known if of.visits and state.views.get(b)})
        if (active := state.active) is not None:
            block = None if active.is_whole else active.geometry.block
            seen = len(active.trained_on)
            history._begin(VisitBegan(active.number, state.sweep, block, active.steps, seen, 0))
        return history

    def note(self, event: Event, seconds: float) -> None:
        """Take an event in; `seconds` of training have passed."""
        match event:
            case VisitBegan():
                self._begin(event)
            case StepTaken():
                self._take_step(event, seconds)
            case BlockSplit():
                self.visits[event.new] = self.visits.get(event.block, 0)
            case VisitEnded():
                self._end_visit(event)

    def end(self, seconds: float) -> None:
        """The run is over: its curve ends where it does, however short it was."""
        if self._recent:
            self._add_point(seconds)

    def _begin(self, visit: VisitBegan) -> None:
        self.under_way[visit.visit], self._crops[visit.visit] = visit, []

    def _take_step(self, step: StepTaken, seconds: float) -> None:
        if not math.isfinite(step.psnr):
            return
        self._crops.setdefault(step.visit, []).append(step.psnr)
        self._recent.append(step.psnr)
        if not self.curve or seconds - self.curve[-1][0] >= SECONDS_BETWEEN_POINTS:
            self._add_point(seconds)

    def _end_visit(self, visit: VisitEnded) -> None:
        crops = self._crops.pop(visit.visit, [])
        self.under_way.pop(visit.visit, None)
        if visit.block is None:
            return
        self.visits[visit.block] = self.visits.get(visit.block, 0) + 1
        if crops:
            self.psnr[visit.block] = sum(crops) / len(crops)

    def _add_point(self, seconds: float) -> None:
        self.curve.append((seconds, sum(self._recent) / len(self._recent)))
        self._recent = []
        if len(self.curve) > MOST_POINTS:
            del self.curve[-2::-2]

    def status(self, block: int, views: int | None) -> Status:
        """Of one block, on which so many views are worth training, if that is known."""
        for visit in self.under_way.values():
            if visit.block in (block, None):
                return Status.WARM_UP if visit.block is None else Status.ACTIVE
        if views is not None and views <= TOO_FEW_VIEWS:
            return Status.UNDER_OBSERVED
        return Status.DONE if self.visits.get(block) else Status.UNTRAINED

    def rows(self, counts: Mapping[int, int | None], views: Mapping[int, int]) -> list[BlockRow]:
        """The table: a row for each block of `counts`, in its order."""
        return [
            BlockRow(b, self.status(b, views.get(b)), count, self.psnr.get(b), views.get(b))
            for b, count in counts.items()
        ]


def time_left(run: Trainer) -> float | None:
    """Seconds that a run takes yet, the final pruning included, at its pace so far; None before a step.

    The pruning draws some views forward and backward, and a few others ROUNDS + 1 times forward alone.
    """
    config, progress, views = run.config, min(run.progress, 1.0), len(run.views)
    if not run.state.step or not progress > 0:
        return None
    steps, of_step = run.state.step / progress, run.stopwatch.seconds / run.state.step
    prunes = config.density.price > 0 and config.density.strategy != "off" and not config.recipe.exact
    ranking = min(max(steps / run.scene.tree.num_blocks / RANKING, FEWEST), views)
    telling = min(max(steps / STEPS_EACH, FEWEST), MOST, views)
    pruning = ranking + FORWARD * (ROUNDS + 1) * telling if prunes else 0
    return of_step * (steps * (1 - progress) + pruning)
