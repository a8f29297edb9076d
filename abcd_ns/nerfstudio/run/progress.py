"""Where the training stands, in the terminal: epoch, block, steps, PSNR, Gaussians, memory, time left."""

import math
import shutil
import time
from collections.abc import Sequence

import psutil
import torch
from nerfstudio.utils.rich_utils import CONSOLE
from rich.live import Live
from rich.text import Text

from abcd_ns.data.input_errors import say
from abcd_ns.engine import events
from abcd_ns.engine.train.run_state import UNLIMITED, RunState, standing
from abcd_ns.engine.train.trainer import Trainer
from abcd_ns.nerfstudio.run.log_lines import VisitEndLine, layer_share
from abcd_ns.terminal import many
from abcd_ns.units import GIB, bytes_in_words
from abcd_ns.viewer.texts import clock, time_left

SECONDS_BETWEEN_LINES, SECONDS_BETWEEN_LOOKS = 10.0, 0.1
"""Where the output is no terminal, such as a log file, and where it is one."""
SMOOTHING = 0.98  # weight of the PSNR that was shown before
ALARMING = ("gradients", "moments", "values")
"""Repairs that are printed at once; the others are counted for the end."""
REPAIRED = {
    "gradients": "gradients that were no numbers set to zero",
    "moments": "moments that were no numbers set to zero",
    "values": "Gaussians that were no numbers replaced",
    "oversized": "oversized Gaussians shrunk",
    "pruned": "Gaussians pruned that filled too little of their views",
}
"""What the counts of a BlockHealth say."""


class ProgressReport:
    """Listens to a coordinator, and reads the `visits` to which the log adds. On a terminal it shows one live
    line; elsewhere it prints a line every few seconds."""

    def __init__(self, coordinator: Trainer, visits: Sequence[VisitEndLine] = ()) -> None:
        self._coordinator, self._visits = coordinator, visits
        self._held_out: events.HeldOutScored | None = None
        self._psnr: float | None = None
        self._visit: events.VisitBegan | None = None
        self._workers: tuple[events.WorkerSeen, ...] = ()
        self._shown = time.monotonic()
        self._live = Live(console=CONSOLE, transient=True)

    def __call__(self, event: events.Event) -> None:
        """Take note of an event."""
        match event:
            case events.VisitBegan():
                self._visit = event
                self._show("")
            case events.LayersDrawn():
                self._show(f"layers {event.done}/{event.total}")
            case events.StepTaken():
                self._take_step(event)
            case events.EpochEnded() if self._coordinator.scene.tree.num_blocks > 1:
                self._print(f"epoch {event.epoch} done at step {event.step:,}: {self._summary()}")
            case events.HeldOutScored():
                self._held_out = event
            case events.Pruning():
                self._show(f"final pruning {event.done}/{event.total}", event.done / event.total)
            case events.PrunedAtEnd():
                self._print(_pruned(event))
            case events.WorkersSeen():
                self._workers = event.workers
                self._show("")
            case events.WorkerLost():
                self._print(f"{_block(event.block)}: lost its worker, trained again: {event.why}")
            case events.Repaired() if event.what in ALARMING:
                self._print(f"{_block(event.block)}: {event.count:,} {REPAIRED[event.what]}")

    def scalars(self) -> dict[str, float]:
        """Where the training stands, for TensorBoard, wandb and comet; block 0 is the warm-up or no visit."""
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
        """Replace the live line by a summary of the run."""
        self._live.stop()
        state = self._coordinator.state
        steps, visits = many(state.step, "step", "steps"), many(state.visit, "visit", "visits")
        seconds = clock(self._coordinator.stopwatch.seconds)
        say(f"Trained {steps} in {visits}, {seconds}: {self._summary()}.")
        lines = summary(self._coordinator.scene.tree.num_blocks, state)
        wanted, degree = self._coordinator.config.sh_degree, state.sh_degree
        if self._coordinator.config.limits.late_harmonics and degree < wanted:
            lines.append(f"harmonics up to degree {degree} of {wanted}: others had no room, or no time")
        for line in lines if state.health else []:  # exact joint training has no visits
            say(f"  {line}")

    def _take_step(self, event: events.StepTaken) -> None:
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
        """Show what is done on a line; `pruned` is the share of the final pruning that is done."""
        least = SECONDS_BETWEEN_LOOKS if CONSOLE.is_terminal else SECONDS_BETWEEN_LINES
        if time.monotonic() - self._shown < least:
            return
        parts = self._parts(what, pruned)
        if not CONSOLE.is_terminal:
            self._print(f"  {'  '.join(parts)}")
            return
        self._shown = time.monotonic()
        self._live.start()
        columns = min(CONSOLE.width, shutil.get_terminal_size().columns)  # nerfstudio's width is always 120
        while len(parts) > 2 and len("  ".join(parts)) >= columns:
            parts.pop()
        self._live.update(Text("  ".join(parts)[: columns - 1]))

    def _print(self, line: str) -> None:
        self._shown = time.monotonic()
        say(line)

    def _parts(self, what: str, pruned: float | None) -> list[str]:
        """Parts of the line, the most important first."""
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
        gpu = ""
        if torch.cuda.is_available():
            gpu = f"{bytes_in_words(torch.cuda.max_memory_allocated())} GPU, "
        parts = [
            f"{coordinator.progress:.1%}",
            f"{where}{what}",
            "" if left is None else f"{clock(left * (1 - (pruned or 0)))} left",
            "" if self._psnr is None else f"{self._psnr:.2f} dB training",
            f"{coordinator.count():,} Gaussians",
            f"{gpu}{bytes_in_words(psutil.Process().memory_info().rss)} RAM",
        ]
        return [part for part in parts if part]


def _pruned(event: events.PrunedAtEnd) -> str:
    before, cost = event.gaussians + event.gone, event.before - event.after
    said = f"Pruned {event.gone:,} of {before:,} Gaussians"
    return f"{said} (costs {cost:.2f} dB on {event.views} training views)." if event.gone else f"{said}."


def _block(block: int | None) -> str:
    return "warm-up" if block is None else f"block {block + 1}"


def _at_work(workers: Sequence[events.WorkerSeen]) -> str:
    busy = [str(worker.block + 1) for worker in workers if worker.block is not None]
    which = f": blocks {', '.join(busy[:4])}{', ...' if len(busy) > 4 else ''}" if busy else ""
    return f"{len(busy)} of {len(workers)} workers busy{which}"


def summary(blocks: int, state: RunState) -> list[str]:
    """Lines for the end of a run: how the blocks stand, and what had to be repaired. Blocks count from 1."""
    by_standing: dict[str, list[int]] = {}
    active = None if state.active is None else state.active.geometry.block
    for block in range(blocks):
        words = standing(block, state.health.get(block), state.views)
        by_standing.setdefault("in training when stopped" if block == active else words, []).append(block + 1)
    if list(by_standing) == ["trained"]:
        lines = ["1 block: trained" if blocks == 1 else f"all {blocks} blocks: trained"]
    else:
        lines = []
        for words, members in by_standing.items():
            shown = ", ".join(map(str, members[:12])) + (", ..." if len(members) > 12 else "")
            lines.append(f"{'block' if len(members) == 1 else 'blocks'} {shown}: {words}")
    records = state.health.values()
    totals = {name: sum(getattr(record, name) for record in records) for name in REPAIRED}
    found = [f"{total:,} {REPAIRED[name]}" for name, total in totals.items() if total]
    return [*lines, ", ".join(found)] if found else lines
