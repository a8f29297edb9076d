"""Where the training stands, in the terminal: epoch, block, steps, PSNR, Gaussians, memory, time left."""

import math
import time
from collections.abc import Sequence

import psutil
import torch
from nerfstudio.utils.rich_utils import CONSOLE
from rich.live import Live
from rich.text import Text

from abcd_ns.engine.events import (
    EpochEnded,
    Event,
    HeldOutScored,
    LayersDrawn,
    PrunedAtEnd,
    Pruning,
    Repaired,
    StepTaken,
    VisitBegan,
    WorkerLost,
    WorkerSeen,
    WorkersSeen,
)
from abcd_ns.engine.train.health_record import REPAIRED, summary
from abcd_ns.engine.train.run_state import UNLIMITED
from abcd_ns.engine.train.trainer import Trainer
from abcd_ns.nerfstudio.run.log_lines import VisitEndLine, layer_share
from abcd_ns.units import GIB, bytes_in_words
from abcd_ns.viewer.status import time_left
from abcd_ns.viewer.texts import clock

SECONDS_BETWEEN_LINES = 10.0
"""Where the output is no terminal (a log file, say), a line is printed this often."""
SECONDS_BETWEEN_LOOKS = 0.1
"""On a terminal no line is made more often: a step may be shorter, and memory takes asking."""
SMOOTHING = 0.98
"""Of the PSNR shown: the weight of what was there before."""

ALARMING = ("gradients", "moments", "values")
"""What is said at once when it is repaired; the rest is counted and said at the end."""


class ProgressReport:
    """Listens to a coordinator. On a terminal one live line; elsewhere a line every few seconds.

    Args:
        visits: those that ended so far, of the whole run; the log goes on adding to them.
    """

    def __init__(self, coordinator: Trainer, visits: Sequence[VisitEndLine] = ()) -> None:
        self._coordinator, self._visits = coordinator, visits
        self._held_out: HeldOutScored | None = None
        self._psnr: float | None = None
        self._visit: VisitBegan | None = None
        self._workers: tuple[WorkerSeen, ...] = ()
        self._last_line = self._last_look = time.monotonic()
        self._live: Live | None = None

    def __call__(self, event: Event) -> None:
        """Take note of an event."""
        match event:
            case VisitBegan():
                self._visit = event
                self._show("")
            case LayersDrawn():
                self._show(f"layers {event.done}/{event.total}")
            case StepTaken():
                self._take_step(event)
            case EpochEnded() if self._coordinator.scene.tree.num_blocks > 1:
                self._print(f"epoch {event.epoch} done at step {event.step:,}: {self._summary()}")
            case HeldOutScored():
                self._held_out = event
            case Pruning():
                self._show(f"final pruning {event.done}/{event.total}", event.done / event.total)
            case PrunedAtEnd():
                self._print(_pruned(event))
            case WorkersSeen():
                self._workers = event.workers
                self._show("")
            case WorkerLost():
                self._print(f"{_block(event.block)}: lost its worker, trained again: {event.why}")
            case Repaired() if event.what in ALARMING:
                self._print(f"{_block(event.block)}: {event.count:,} {REPAIRED[event.what]}")

    def scalars(self) -> dict[str, float]:
        """Where the training stands, by name, for TensorBoard, wandb and comet.

        Blocks count from 1; 0 is the warm-up, or a method that has no visits.
        """
        coordinator, block = self._coordinator, None if self._visit is None else self._visit.block
        found = {
            "block": 0 if block is None else block + 1,
            "blocks": coordinator.scene.tree.num_blocks,
            "epoch": coordinator.state.epoch,
            "gaussians": coordinator.count(),
            "share of time for layers": layer_share(self._visits),
            "RAM (GiB)": psutil.Process().memory_info().rss / GIB,
        }
        if torch.cuda.is_available():
            found["GPU (GiB)"] = torch.cuda.memory_allocated() / GIB
        return found

    def close(self) -> None:
        """Take the live line away and say what became of the run."""
        if self._live is not None:
            self._live.stop()
            self._live = None
        state = self._coordinator.state
        visits = "1 visit" if state.visit == 1 else f"{state.visit} visits"
        CONSOLE.print(
            f"Trained {state.step:,} steps in {visits}, "
            f"{clock(self._coordinator.stopwatch.seconds)}: {self._summary()}.",
            highlight=False,
            soft_wrap=True,
        )
        lines = summary(self._coordinator.scene.tree.num_blocks, state.health, state.views)
        wanted, degree = self._coordinator.config.sh_degree, state.sh_degree
        if self._coordinator.config.limits.late_harmonics and degree < wanted:
            lines.append(f"harmonics up to degree {degree} of {wanted}: others had no room, or no time")
        for line in lines if state.health else []:  # exact joint training has no visits
            CONSOLE.print(f"  {line}", highlight=False)

    def _take_step(self, event: StepTaken) -> None:
        self._held_out = None  # of an earlier step
        if math.isfinite(event.psnr):
            before = event.psnr if self._psnr is None else self._psnr
            self._psnr = SMOOTHING * before + (1 - SMOOTHING) * event.psnr
        if self._workers:
            return
        steps = self._visit.steps if self._visit else 0
        endless = not 0 < steps < UNLIMITED or (self._visit is not None and self._visit.block is None)
        self._show(f"step {event.visit_step}" if endless else f"step {event.visit_step}/{steps}")

    def _summary(self) -> str:
        quality = "PSNR not measured"
        if self._held_out is not None:
            quality = f"held-out PSNR {self._held_out.psnr:.2f} dB"
        elif self._psnr is not None:
            quality = f"PSNR {self._psnr:.2f} dB on training crops"
        share = layer_share(self._visits)
        return f"{quality}, {self._coordinator.count():,} Gaussians, {share:.0%} of the time for layers"

    def _show(self, what: str, pruned: float | None = None) -> None:
        now = time.monotonic()
        if CONSOLE.is_terminal:
            if now - self._last_look >= SECONDS_BETWEEN_LOOKS:
                self._last_look = now
                if self._live is None:
                    self._live = Live(console=CONSOLE, transient=True)
                    self._live.start()
                self._live.update(Text(fitting(self._parts(what, pruned), CONSOLE.width - 1)))
        elif now - self._last_line > SECONDS_BETWEEN_LINES:
            self._print(f"  {'  '.join(self._parts(what, pruned))}")

    def _print(self, line: str) -> None:
        self._last_line = time.monotonic()
        CONSOLE.print(line, highlight=False, soft_wrap=True)

    def _parts(self, what: str, pruned: float | None) -> list[str]:
        """Of the line, the most important first; `pruned` is the share of the final pruning that is done."""
        coordinator, visit = self._coordinator, self._visit
        if pruned is not None:
            where = ""
        elif visit is not None and visit.block is None:
            where = "warm-up "
        elif self._workers:
            where = _at_work(self._workers)
        else:
            at = "-" if visit is None else visit.block + 1
            where = f"block {at}/{coordinator.scene.tree.num_blocks} "
        left = time_left(coordinator)  # what workers are at counts as progress, and says nothing of time
        parts = [
            f"{coordinator.progress:.1%}",
            f"{where}{what}",
            "" if left is None else f"{clock(left * (1 - (pruned or 0)))} left",
            "" if self._psnr is None else f"{self._psnr:.2f} dB training",
            f"{coordinator.count():,} Gaussians",
            _memory(),
        ]
        return [part for part in parts if part]


def fitting(parts: Sequence[str], width: int) -> str:
    """As many parts as fit into a line of a terminal, the first two at least."""
    shown = list(parts)
    while len(shown) > 2 and len("  ".join(shown)) > width:
        shown.pop()
    return "  ".join(shown)[:width]


def _pruned(event: PrunedAtEnd) -> str:
    before, cost = event.gaussians + event.gone, event.before - event.after
    said = f"Pruned {event.gone:,} of {before:,} Gaussians"
    return f"{said} (costs {cost:.2f} dB on {event.views} training views)." if event.gone else f"{said}."


def _block(block: int | None) -> str:
    return "warm-up" if block is None else f"block {block + 1}"


def _at_work(workers: Sequence[WorkerSeen]) -> str:
    """What workers are doing, in few words."""
    busy = [str(worker.block + 1) for worker in workers if worker.block is not None]
    which = f": blocks {', '.join(busy[:4])}{', ...' if len(busy) > 4 else ''}" if busy else ""
    return f"{len(busy)} of {len(workers)} workers busy{which}"


def _memory() -> str:
    resident = f"{bytes_in_words(psutil.Process().memory_info().rss)} RAM"
    if not torch.cuda.is_available():
        return resident
    return f"{bytes_in_words(torch.cuda.max_memory_allocated())} GPU, {resident}"
