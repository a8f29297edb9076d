"""What several workers bring, what they cost the driver, and what it costs when they are killed.

    python -m benchmarks.workers --data DIR --downscale 4 --workers 1 2 --seconds 60
    python -m benchmarks.workers --data DIR --downscale 4 --workers 2 --steps 3000 --kills 20 --out FILE

Runs of ns-train's own trainer, one after the other. A rate is over the time in which blocks were lent: the
warm-up, which the driver trains, is left out. With --kills a random worker is killed again and again, in
equal shares of the steps that workers take, each when the last one's visit is lent again. A second table says
what each cost. Of a run with a budget of steps nobody can tell from its scene that any was.
"""

import os
import random
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path

import tyro

from abcd_ns.cluster.dispatcher import Dispatcher
from abcd_ns.cluster.lease import Lease, Report, Workers
from abcd_ns.engine.events import Event, VisitBegan, VisitEnded, WorkerLost, WorkersSeen
from abcd_ns.engine.gaussians.block_state import BlockState
from abcd_ns.engine.kernels import share_cores
from abcd_ns.engine.types import Gaussians
from abcd_ns.lab.runs.evaluate import mean_psnr
from abcd_ns.nerfstudio.run import STATE
from abcd_ns.units import MIB
from benchmarks.runs import apart, config_of, print_machine, write_runs
from tests.reference.crash_runs import digest


@dataclass
class Args:
    """What to measure."""

    data: Path
    """As of ns-train."""
    downscale: int = 4
    workers: tuple[int, ...] = (1, 2)
    """Numbers of workers to try; 1 trains in one process, by one thread."""
    blocks: int = 8
    seconds: float | None = None
    steps: int | None = None
    """Of a run; give one of both."""
    kills: int = 0
    """Of workers, in a second run of each row."""
    seed: int = 0
    out: Path | None = None
    """Where to write the results, JSON."""


@dataclass
class Kill:
    """Of a worker, and what it cost."""

    step: int
    """Steps that the run had heard of, visits that are out included."""
    block: int | None = None
    """Whose visit was lost, from 0; None where the worker had none."""
    steps_lost: int = 0
    """Of that visit, as far as the driver had heard."""
    seconds_to_notice: float | None = None
    seconds_to_lend: float | None = None
    """From the kill until the visit was with another worker."""


@dataclass
class Row:
    """What came of one run."""

    workers: int
    kills: list[Kill] = field(default_factory=list)
    began: float = 0.0
    """When the first visit to a block began."""
    seconds: float = 0.0
    """From then to the end."""
    ended: list[int] = field(default_factory=list)
    """Numbers of the visits that were taken in, in order, the warm-up's included."""
    visits: int = 0
    """To blocks."""
    steps: int = 0
    waited: float = 0.0
    """Share of the driver's time in which it waited for workers."""
    lent: int = 0
    """Bytes of blocks that were shared."""
    psnr: float = 0.0
    digest: str = ""
    """Of all that the run has left in its store, but for times."""

    @property
    def is_whole(self) -> bool:
        """Whether each visit was taken in, and once: in the order in which they were to end, not began."""
        return sorted(self.ended) == list(range(len(self.ended)))


class Watch:
    """Follows a run: notes visits, and kills workers when their time has come."""

    def __init__(self, row: Row, trainer: Dispatcher, kills: int, seed: int) -> None:
        self._row, self._trainer, self._left = row, trainer, kills
        self._kills, self._rng = kills, random.Random(seed)
        self._done: dict[int | None, int] = {}
        self._first, self._killed_at = None, 0.0
        if kills:
            self._submit, trainer.workers.submit = trainer.workers.submit, self._lend

    def __call__(self, event: Event) -> None:
        match event:
            case VisitBegan(block=int()):
                self._row.began = self._row.began or time.perf_counter()
            case VisitEnded():
                self._row.ended.append(event.visit)
                self._row.visits += event.block is not None
            case WorkerLost() if self._pending:
                kill = self._row.kills[-1]
                kill.block, kill.steps_lost = event.block, self._done.get(event.block, 0)
                kill.seconds_to_notice = time.perf_counter() - self._killed_at
            case WorkersSeen():
                self._done = {worker.block: worker.done for worker in event.workers}
                if self._left and not self._pending:
                    self._kill()

    @property
    def _pending(self) -> bool:
        """Whether the last kill's visit is not lent again."""
        return bool(self._row.kills) and self._row.kills[-1].seconds_to_lend is None

    def _kill(self) -> None:
        trainer = self._trainer
        step = trainer.state.step + sum(self._done.values())
        self._first = step if self._first is None else self._first
        share = (self._kills - self._left + 0.5) / self._kills
        pids = trainer.workers.pids  # none where no worker is out: then the next chance is waited for
        if pids and step >= self._first + share * (trainer.run.budget.steps - self._first):
            with suppress(ProcessLookupError):  # it has just ended by itself
                os.kill(self._rng.choice(pids), signal.SIGKILL)
                self._killed_at, self._left = time.perf_counter(), self._left - 1
                self._row.kills.append(Kill(step))

    def _lend(self, lease: Lease) -> None:
        self._submit(lease)
        if self._pending and self._row.kills[-1].block == lease.task.active.geometry.block:
            self._row.kills[-1].seconds_to_lend = time.perf_counter() - self._killed_at


def measure(args: Args, workers: int, kills: int, out: Path) -> Row:
    """One run."""
    options = {name: getattr(args, name) for name in ("downscale", "blocks", "seed", "steps", "seconds")}
    config = config_of(args.data, out, workers=max(workers, 1), **options)
    if workers == 1:
        share_cores(1)
    else:
        share_cores(os.cpu_count() or 1)
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    row, coordinator = Row(workers), trainer.pipeline.coordinator
    coordinator.announce.subscribe(Watch(row, coordinator, kills, args.seed))
    waiting = _count_waiting(row, coordinator.workers) if workers > 1 else [0.0]
    began = time.perf_counter()
    trainer.train()
    ended = time.perf_counter()
    row.seconds = ended - (row.began or began)
    row.waited = waiting[0] / row.seconds
    row.steps = coordinator.state.step
    row.psnr = mean_psnr(trainer.pipeline)
    coordinator.close()
    row.digest = digest(trainer.base_dir / STATE)
    return row


def _count_waiting(row: Row, workers: Workers) -> list[float]:
    """From now on count what the driver waits, seconds, and the bytes that it shares."""
    waiting, wait, share = [0.0], workers.wait, workers.share

    def timed(seconds: float) -> list[Report]:
        began = time.perf_counter()
        try:
            return wait(seconds)
        finally:
            waiting[0] += (time.perf_counter() - began) * bool(row.began)

    def counted(value: Gaussians | BlockState) -> Callable[[], Gaussians | BlockState]:
        row.lent += value.nbytes
        return share(value)

    workers.wait, workers.share = timed, counted
    return waiting


def main(args: Args) -> None:
    """Measure, and print tables."""
    if (args.seconds is None) == (args.steps is None) or (args.kills and args.steps is None):
        sys.exit("give --seconds or --steps; with --kills it must be --steps")
    budget = f"{args.seconds:g} s" if args.seconds else f"{args.steps:,} steps"
    print_machine(f"{args.data.name}, downscale {args.downscale}, {args.blocks} blocks, {budget}\n")
    print("| workers | kills | visits | visits/s | steps | seconds | driver waits | MiB a visit | PSNR |")
    print("| ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |")
    rows = []
    for workers in args.workers:
        for kills in dict.fromkeys((0, args.kills if workers > 1 else 0)):
            with tempfile.TemporaryDirectory() as out:
                row = apart(measure, args, workers, kills, Path(out))
            rows.append(row)
            lent, rate = row.lent / max(row.visits, 1) / MIB, row.visits / row.seconds
            print(
                f"| {row.workers or 'none'} | {len(row.kills)} | {row.visits} | {rate:.2f} | "
                f"{row.steps:,} | {row.seconds:.1f} | {row.waited:.0%} | {lent:.1f} | {row.psnr:.2f} |",
                flush=True,
            )
            if kills:
                print(table_of_kills(row, rows[-2]))
    write_runs(args.out, {"asked": {**asdict(args), "data": args.data.name, "out": None}}, rows)


def table_of_kills(row: Row, undisturbed: Row) -> str:
    """What each kill cost, and whether anything is left of them."""
    lines = ["\n| kill | at step | block | steps lost | noticed after | lent again after |"]
    lines += ["| ---: " * 6 + "|"]
    for number, kill in enumerate(row.kills, start=1):
        block = "-" if kill.block is None else kill.block + 1
        times = (kill.seconds_to_notice, kill.seconds_to_lend)
        noticed, lent = ("-" if t is None else f"{t:.1f} s" for t in times)
        lines += [f"| {number} | {kill.step:,} | {block} | {kill.steps_lost} | {noticed} | {lent} |"]
    once = "each visit was taken in once" if row.is_whole else "VISITS ARE MISSING, OR THERE TWICE"
    same = "the same to the last bit" if row.digest == undisturbed.digest else "ANOTHER"
    return "\n".join([*lines, "", f"{once}; the scene and its run's state are {same} as without kills\n"])


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
