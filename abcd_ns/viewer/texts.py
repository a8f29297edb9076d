"""Where a run and its blocks stand, in the words of panel and terminal."""

import os
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from datetime import timedelta
from enum import Enum
from pathlib import Path

from abcd_ns.engine.events import WorkerSeen
from abcd_ns.engine.train.run_state import TOO_FEW_VIEWS, BlockHealth, RunState
from abcd_ns.engine.train.step.final_pruning import FEWEST, MOST, RANKING, ROUNDS, STEPS_EACH
from abcd_ns.engine.train.trainer import Trainer
from abcd_ns.terminal import many
from abcd_ns.units import bytes_in_words
from abcd_ns.viewer.guard import THIS_MACHINE

MOST_ROWS = 24  # of the table of blocks; with more blocks those that are active or under-observed come first
CONTAINER_MARKS = (Path("/.dockerenv"), Path("/run/.containerenv"))  # left by docker and podman
FORWARD = 0.5  # time of drawing a picture, in steps, which draw it backward, too


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
    gaussians: int | None = None  # None while a coarse model of all blocks is trained
    psnr: float | None = None  # of the training crops in the later half of its last visit, dB
    views: int | None = None  # worth training it on; None while that is unknown


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
    """Seconds that a run takes yet at its pace so far; None before a step. The final pruning draws some views
    forward and backward, and a few others ROUNDS + 1 times forward alone."""
    config, progress, views = run.config, min(run.progress, 1.0), len(run.views)
    if not run.state.step or not progress > 0:
        return None
    steps, of_step = run.state.step / progress, run.stopwatch.seconds / run.state.step
    prunes = config.density.prunes and not config.recipe.exact
    ranking = min(max(steps / run.scene.tree.num_blocks / RANKING, FEWEST), views)
    telling = min(max(steps / STEPS_EACH, FEWEST), MOST, views)
    pruning = ranking + FORWARD * (ROUNDS + 1) * telling if prunes else 0
    return of_step * (steps * (1 - progress) + pruning)


def reach(host: str) -> str | None:
    """How to reach a viewer that listens on `host` of a container; None where there is no more to say."""
    inside = any(mark.exists() for mark in CONTAINER_MARKS) or "KUBERNETES_SERVICE_HOST" in os.environ
    if not inside or host not in (THIS_MACHINE, "localhost"):
        return None
    fix = "--viewer.websocket-host 0.0.0.0 and a published port let it be. It has no password"
    return f"The viewer listens on {host}, which from outside this container cannot be reached; {fix}."


def clock(seconds: float | None) -> str:
    """A duration as h:mm:ss."""
    return "unknown" if seconds is None else str(timedelta(seconds=int(seconds)))


def worker_line(worker: WorkerSeen) -> str:
    """What a worker is doing; workers count from 1."""
    what = "waits" if worker.visits else "is starting"
    if worker.block is not None:
        what = f"block {worker.block + 1}, step {worker.done} of {worker.steps}"
    lost = f", replaced {worker.deaths}x" if worker.deaths else ""
    return f"Worker {worker.worker + 1}: {what}; {many(worker.visits, 'visit', 'visits')}{lost}"


def block_table(rows: Sequence[BlockRow]) -> str:
    """The blocks by number, counted from 1 as in the terminal, without columns that nothing is known of."""
    urgent = (Status.ACTIVE, Status.UNDER_OBSERVED)
    first = sorted(rows, key=lambda row: (row.status not in urgent, row.block))[:MOST_ROWS]
    shown = sorted(first, key=lambda row: row.block)
    trained = any(row.psnr is not None or row.views is not None for row in rows)
    lines = ["| # | state | Gaussians |" + " PSNR | views |" * trained]
    lines += ["| ---: | --- | ---: |" + " ---: | ---: |" * trained]
    for row in shown:
        status = f"**{row.status.value}**" if row.status is Status.ACTIVE else row.status.value
        cells = [str(row.block + 1), status, "-" if row.gaussians is None else f"{row.gaussians:,}"]
        if trained:
            cells.append("-" if row.psnr is None else f"{row.psnr:.2f}")
            cells.append("-" if row.views is None else str(row.views))
        lines.append(f"| {' | '.join(cells)} |")
    if len(rows) > len(shown):
        counts = Counter(row.status.value for row in rows)
        said = ", ".join(f"{count} {name}" for name, count in sorted(counts.items()))
        lines += ["", f"{len(rows)} blocks: {said}."]
    return "\n".join(lines)


def memory_table(rows: Sequence[tuple[str, int, int]]) -> str:
    """What is held, against its limit: rows of (what, bytes, limit in bytes)."""
    lines = ["| memory | used | of |", "| --- | ---: | ---: |"]
    lines += [f"| {what} | {bytes_in_words(used)} | {bytes_in_words(limit)} |" for what, used, limit in rows]
    return "\n".join(lines)
