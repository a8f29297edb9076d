"""The panel's texts, as Markdown, and the terminal's."""

import os
from collections import Counter
from collections.abc import Sequence
from datetime import timedelta
from pathlib import Path

from abcd_ns.engine.events import WorkerSeen
from abcd_ns.units import bytes_in_words
from abcd_ns.viewer.guard.rules import THIS_MACHINE
from abcd_ns.viewer.status import BlockRow, Status

MOST_ROWS = 24
"""Of the table of blocks; with more blocks those that are active or under-observed come first."""
CONTAINER_MARKS = (Path("/.dockerenv"), Path("/run/.containerenv"))
"""What docker and podman leave in their containers."""


def reach(host: str) -> str | None:
    """How to reach a viewer that listens on `host` of a container; None where there is no more to say."""
    inside = any(mark.exists() for mark in CONTAINER_MARKS) or "KUBERNETES_SERVICE_HOST" in os.environ
    if not inside or host not in (THIS_MACHINE, "localhost"):
        return None
    return (
        f"The viewer listens on {host}, which from outside this container cannot be reached; "
        "--viewer.websocket-host 0.0.0.0 and a published port let it be. It has no password."
    )


def clock(seconds: float | None) -> str:
    """A duration as h:mm:ss."""
    return "unknown" if seconds is None else str(timedelta(seconds=int(seconds)))


def worker_line(worker: WorkerSeen) -> str:
    """What a worker is doing; workers count from 1."""
    what = "waits" if worker.visits else "is starting"
    if worker.block is not None:
        what = f"block {worker.block + 1}, step {worker.done} of {worker.steps}"
    lost = f", replaced {worker.deaths}x" if worker.deaths else ""
    visits = "1 visit" if worker.visits == 1 else f"{worker.visits} visits"
    return f"Worker {worker.worker + 1}: {what}; {visits}{lost}"


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
