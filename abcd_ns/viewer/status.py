"""Where a run and its blocks stand: functions of what its trainer knows."""

from collections.abc import Collection
from dataclasses import dataclass
from enum import Enum

from abcd_ns.engine.train.health_record import TOO_FEW_VIEWS, BlockHealth
from abcd_ns.engine.train.run_state import RunState
from abcd_ns.engine.train.step.final_pruning import FEWEST, MOST, RANKING, ROUNDS, STEPS_EACH
from abcd_ns.engine.train.trainer import Trainer

FORWARD = 0.5
"""Time of drawing a picture, in steps, which draw it backward, too."""


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
    gaussians: int | None = None
    """None while a coarse model of all blocks is trained."""
    psnr: float | None = None
    """Of the training crops in the later half of its last visit, dB."""
    views: int | None = None
    """Worth training it on; None while that is unknown."""


def status_of(block: int, state: RunState, active: Collection[int]) -> Status:
    """The status of a block while `active` ones are in training."""
    if state.active is not None and state.active.is_whole:
        return Status.WARM_UP
    if block in active:
        return Status.ACTIVE
    if state.views.get(block, TOO_FEW_VIEWS + 1) <= TOO_FEW_VIEWS:
        return Status.UNDER_OBSERVED
    return Status.DONE if state.health.get(block, BlockHealth()).visits else Status.UNTRAINED


def time_left(run: Trainer) -> float | None:
    """Seconds that a run takes yet, the final pruning included, at its pace so far; None before a step.

    The pruning draws some views forward and backward, and a few others ROUNDS + 1 times forward alone.
    """
    config, progress, views = run.config, min(run.progress, 1.0), len(run.views)
    if not run.state.step or not progress > 0:
        return None
    steps, of_step = run.state.step / progress, run.stopwatch.seconds / run.state.step
    prunes = config.density.prunes_at_end and not config.recipe.exact
    ranking = min(max(steps / run.scene.tree.num_blocks / RANKING, FEWEST), views)
    telling = min(max(steps / STEPS_EACH, FEWEST), MOST, views)
    pruning = ranking + FORWARD * (ROUNDS + 1) * telling if prunes else 0
    return of_step * (steps * (1 - progress) + pruning)
