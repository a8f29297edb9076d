"""What several workers bring, what they cost the driver, and what it costs when they are killed.

    python -m benchmarks.workers --data DIR --downscale 4 --workers 1 2 --seconds 60
    python -m benchmarks.workers --data DIR --downscale 4 --workers 2 --steps 3000 --kills 20

Runs of ns-train's own trainer, one after the other. A rate is over the time in which blocks were lent: the
warm-up, which the driver trains, is left out. With --kills a random worker is killed again and again, in
equal shares of the run; what that cost is seen against the run of the same row without.
"""

import copy
import multiprocessing
import os
import platform
import random
import signal
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import torch
import tyro
from nerfstudio.engine.trainer import TrainerConfig

from abcd_ns import methods
from abcd_ns.cluster.dispatcher import Dispatcher
from abcd_ns.engine.events import Event, StepTaken, VisitBegan, VisitEnded, WorkersSeen
from abcd_ns.lab.runs.evaluate import mean_psnr


@dataclass
class Args:
    """What to measure."""

    data: Path
    """As of ns-train."""
    downscale: int = 4
    workers: tuple[int, ...] = (1, 2)
    """Numbers of workers to try; 0 is no worker, but processes that share the views of a step."""
    blocks: int = 8
    seconds: float | None = None
    steps: int | None = None
    """Of a run; give one of both."""
    kills: int = 0
    """Of workers, in a second run of each row."""
    seed: int = 0


@dataclass
class Row:
    """What came of one run."""

    workers: int
    kills: int = 0
    began: float = 0.0
    """When the first visit to a block began."""
    seconds: float = 0.0
    """From then to the end."""
    visits: int = 0
    steps: int = 0
    waited: float = 0.0
    """Share of the driver's time in which it waited for workers."""
    lent: int = 0
    """Bytes that were put into Ray's store."""
    psnr: float = 0.0
    deaths: list[int] = field(default_factory=list)


class Watch:
    """Follows a run: counts visits, and kills workers when their time has come."""

    def __init__(self, row: Row, trainer: Dispatcher, kills: int, seed: int) -> None:
        self._row, self._trainer = row, trainer
        self._moments = [(k + 0.5) / kills for k in range(kills)]
        self._rng = random.Random(seed)

    def __call__(self, event: Event) -> None:
        row, trainer = self._row, self._trainer
        if isinstance(event, VisitEnded) and event.block is not None:
            row.visits += 1
        if isinstance(event, VisitBegan) and event.block is not None:
            row.began = row.began or time.perf_counter()
        if isinstance(event, WorkersSeen):
            row.deaths = [worker.deaths for worker in event.workers]
        if isinstance(event, (WorkersSeen, StepTaken)) and self._moments and isinstance(trainer, Dispatcher):
            pids = trainer.workers.pids if trainer.trains_elsewhere else []
            if pids and trainer.progress >= self._moments[0]:
                self._moments.pop(0)
                os.kill(self._rng.choice(pids), signal.SIGKILL)
                row.kills += 1


def config_of(args: Args, workers: int, out: Path) -> TrainerConfig:
    """ns-train's, with nothing but training in it."""
    config = copy.deepcopy(methods.abcd.config)
    config.pipeline.datamanager.data = args.data
    config.pipeline.datamanager.dataparser.downscale_factor = args.downscale
    config.pipeline.blocks, config.pipeline.workers = args.blocks, max(workers, 1)
    config.pipeline.cluster = None
    config.pipeline.training.seed = config.machine.seed = args.seed
    config.pipeline.max_seconds = args.seconds
    config.max_num_iterations = args.steps or 10**9
    config.output_dir, config.experiment_name, config.vis = out, "run", "tensorboard"
    config.logging.local_writer.enable = False
    config.steps_per_eval_batch = config.steps_per_eval_image = config.steps_per_eval_all_images = 0
    config.steps_per_save = 0
    config.machine.device_type = "cuda" if torch.cuda.is_available() else "cpu"
    return config


def measure(args: Args, workers: int, kills: int, out: Path) -> Row:
    """One run."""
    config = config_of(args, workers, out)
    if workers == 1:
        config.pipeline.training.processes = 1
        torch.set_num_threads(1)
    else:
        torch.set_num_threads(os.cpu_count() or 1)
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    row, coordinator = Row(workers), trainer.pipeline.coordinator
    coordinator.announce.subscribe(Watch(row, coordinator, kills, args.seed))
    waiting = _count_waiting(row) if workers > 1 else [0.0]
    began = time.perf_counter()
    trainer.train()
    ended = time.perf_counter()
    row.seconds = ended - (row.began or began)
    row.waited = waiting[0] / row.seconds
    row.steps = coordinator.state.step
    row.psnr = mean_psnr(trainer.pipeline)
    return row


def _count_waiting(row: Row) -> list[float]:
    """From now on count what the driver waits, seconds, and the bytes that it puts into the store."""
    from abcd_ns.cluster.ray_workers import RayWorkers, Shared  # by now Ray's environment is set

    waiting, wait, of = [0.0], RayWorkers.wait, Shared.of

    def timed(self: RayWorkers, seconds: float):
        began = time.perf_counter()
        try:
            return wait(self, seconds)
        finally:
            waiting[0] += (time.perf_counter() - began) * bool(row.began)

    def counted(value) -> object:
        row.lent += value.nbytes
        return of(value)

    RayWorkers.wait, Shared.of = timed, staticmethod(counted)
    return waiting


def main() -> None:
    """Measure, and print a table."""
    args = tyro.cli(Args, description=__doc__)
    if (args.seconds is None) == (args.steps is None):
        sys.exit("give --seconds or --steps")
    budget = f"{args.seconds:g} s" if args.seconds else f"{args.steps:,} steps"
    print(f"{args.data.name}, downscale {args.downscale}, {args.blocks} blocks, {budget}, seed {args.seed}")
    print(f"{platform.machine()}, {os.cpu_count()} cores, torch {torch.__version__}\n")
    print("| workers | kills | visits | visits/s | steps | seconds | driver waits | MB lent a visit | PSNR |")
    print("| ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |")
    for workers in args.workers:
        for kills in dict.fromkeys((0, args.kills)):
            # A process of its own: nothing of one run is left for the next.
            with (
                tempfile.TemporaryDirectory() as out,
                multiprocessing.get_context("spawn").Pool(1) as process,
            ):
                row = process.apply(measure, (args, workers, kills, Path(out)))
            lent = row.lent / max(row.visits, 1) / 1e6
            print(
                f"| {row.workers or 'none'} | {row.kills} | {row.visits} | {row.visits / row.seconds:.2f} | "
                f"{row.steps:,} | {row.seconds:.1f} | {row.waited:.0%} | {lent:.1f} | {row.psnr:.2f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
