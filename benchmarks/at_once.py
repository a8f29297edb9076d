"""What it does to a scene that blocks are trained at once: held-out PSNR at a fixed number of steps.

    python -m benchmarks.at_once --data DIR --downscale 4 --visits 1 2 4 8 --seeds 0 1 2 --out FILE

With n visits at once each begins from what the one n before it has left (a lag of n, see docs/cluster.md);
with 1 the run is that of one process. Visits are trained one after the other, in this process and by one
thread, so that neither the machine nor how busy it is has a part in the result. Runs of ns-train's trainer.
"""

import json
import tempfile
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from statistics import fmean

import tyro

from abcd_ns.cluster.dispatcher import Dispatcher
from abcd_ns.cluster.visit_worker import RunSetup
from abcd_ns.engine.events import Event, VisitBegan, VisitEnded
from abcd_ns.engine.kernels import share_cores
from abcd_ns.lab.results.tables import markdown
from abcd_ns.lab.runs.evaluate import mean_psnr
from abcd_ns.nerfstudio import pipeline
from abcd_ns.nerfstudio.workers import make_worker
from benchmarks.runs import apart, config_of, write_runs
from tests.cluster.in_process import InProcessWorkers


@dataclass(kw_only=True)
class Args:
    """What to compare."""

    data: Path
    """The scene, as of ns-train."""
    downscale: int = 4
    """Divides the photos' width and height."""
    blocks: int = 8
    """Of the scene."""
    steps: int = 500
    """Of each run, the warm-up included."""
    visits: tuple[int, ...] = (1, 2, 4, 8)
    """Numbers of visits at once to try."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """A run of each number of visits for each. Runs that `out` has are not made again."""
    out: Path | None = None
    """Where to write the results, JSON."""


@dataclass
class Row:
    """One run."""

    at_once: int
    seed: int
    most_out: int = 0
    """Visits that were out at once at most."""
    visits: int = 0
    """To blocks; the warm-up is none."""
    steps: int = 0
    gaussians: int = 0
    psnr: float = 0.0
    """Of held-out views, merged, dB."""


def run(args: Args, at_once: int, seed: int) -> Row:
    """Train and look at held-out views."""
    row, out = Row(at_once, seed), 0

    def dispatcher_for(training, config, _count, _budget, source, target):
        worker = make_worker(config, RunSetup.of(training, source.room), 0)
        return Dispatcher(training, InProcessWorkers(worker, at_once), at_once, source, target)

    pipeline.dispatcher_for = dispatcher_for

    def hear(event: Event) -> None:
        nonlocal out
        if isinstance(event, VisitBegan) and event.block is not None:
            out += 1
            row.most_out = max(row.most_out, out)
        elif isinstance(event, VisitEnded) and event.block is not None:
            out -= 1
            row.visits += 1

    share_cores(1)
    with tempfile.TemporaryDirectory() as folder:
        options = {"seed": seed, "workers": 2}  # any number but 1 dispatches
        config = config_of(args.data, Path(folder), **shared(args), **options)
        config.machine.device_type = "cpu"
        trainer = config.setup(local_rank=0, world_size=1)
        trainer.setup()
        coordinator = trainer.pipeline.coordinator
        coordinator.announce.subscribe(hear)
        trainer.train()
        row.steps, row.gaussians = coordinator.state.step, coordinator.count()
        row.psnr = mean_psnr(trainer.pipeline)
    return row


def shared(args: Args) -> dict[str, int]:
    """What all runs share, but for where the scene is."""
    return {"downscale": args.downscale, "blocks": args.blocks, "steps": args.steps}


def main(args: Args) -> None:
    """Make the runs that are missing, print the table, write the file after each."""
    asked = {"data": args.data.name, **shared(args)}
    found = json.loads(args.out.read_text()) if args.out is not None and args.out.exists() else {"runs": []}
    if found["runs"] and not asked.items() <= found.items():
        raise SystemExit(f"{args.out} answers another question; name another file, or remove it.")
    rows = {(row["at_once"], row["seed"]): Row(**row) for row in found["runs"]}
    for seed, at_once in product(args.seeds, args.visits):
        if (at_once, seed) not in rows:
            # In a process of its own, so that nothing of one run is left for the next.
            rows[at_once, seed] = row = apart(run, args, at_once, seed)
            print(row, flush=True)
            write_runs(args.out, asked, list(rows.values()))
    table = [["visits at once", *(f"seed {seed}" for seed in args.seeds), "mean"]]
    for at_once in args.visits:
        psnrs = [rows[at_once, seed].psnr for seed in args.seeds]
        table.append([str(at_once), *(f"{psnr:.2f}" for psnr in (*psnrs, fmean(psnrs)))])
    print(markdown(table))


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
