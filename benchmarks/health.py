"""What each rule of health is worth: held-out PSNR at fixed steps with all rules, without one, with none.

    python -m benchmarks.health --data castle-P30 fox --steps 500 --seeds 0 1 --out FILE

Rules that mend what is no number are always on: without them such a run is lost, as `abcd stability` shows.
Every run has a process and one thread of its own. Runs of ns-train's trainer.
"""

import json
import multiprocessing
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro

from abcd_ns.engine.train.health import health
from abcd_ns.lab.runs.evaluate import mean_psnr
from benchmarks import workers
from benchmarks.records import write_runs


def _without_undo() -> None:
    health.is_worse = lambda *_: False


def _without_giants() -> None:
    health.Health.hold_back_giants = lambda *_: None


def _with_neither() -> None:
    _without_undo()
    _without_giants()


ARMS: dict[str, Callable[[], None]] = {
    "all": lambda: None,
    "no visit undone": _without_undo,
    "giants grow": _without_giants,
    "neither": _with_neither,
}
"""By name, what is done to the rules in a run's process."""


@dataclass
class Args:
    """What to compare."""

    data: tuple[Path, ...]
    """As of ns-train; several."""
    downscale: int = 4
    """Divides the photos' width and height."""
    blocks: int = 8
    """Of the scene."""
    steps: int = 500
    """Of each run, the warm-up included."""
    seeds: tuple[int, ...] = (0, 1)
    """A run of each arm for each."""
    out: Path | None = None
    """Where to write the results, JSON; runs that it has are not made again."""


@dataclass
class Row:
    """One run."""

    scene: str
    arm: str
    seed: int
    giants: int = 0
    """Gaussians that were shrunk."""
    undone: int = 0
    """Visits."""
    gaussians: int = 0
    psnr: float = 0.0
    """Of held-out views, merged, dB."""


def run(args: Args, data: Path, arm: str, seed: int) -> Row:
    """Train and look at held-out views."""
    torch.set_num_threads(1)
    ARMS[arm]()
    row = Row(data.name, arm, seed)
    with tempfile.TemporaryDirectory() as folder:
        one = workers.Args(data, args.downscale, blocks=args.blocks, steps=args.steps, seed=seed)
        config = workers.config_of(one, 0, Path(folder))
        config.machine.device_type = "cpu"
        trainer = config.setup(local_rank=0, world_size=1)
        trainer.setup()
        trainer.train()
        coordinator = trainer.pipeline.coordinator
        records = coordinator.state.health.values()
        row.giants = sum(record.giants for record in records)
        row.undone = sum(record.undone for record in records)
        row.gaussians, row.psnr = coordinator.count(), mean_psnr(trainer.pipeline)
    return row


def main(args: Args) -> None:
    """Make the runs that are missing, write the file after each, print the table."""
    asked = {"downscale": args.downscale, "blocks": args.blocks, "steps": args.steps}
    rows = []
    if args.out is not None and args.out.exists():
        found = json.loads(args.out.read_text())
        rows = [Row(**row) for row in found["runs"] if asked.items() <= found.items()]
    made = {(row.scene, row.arm, row.seed): row for row in rows}
    for seed in args.seeds:
        for data in args.data:
            for arm in ARMS:
                if (data.name, arm, seed) in made:
                    continue
                with multiprocessing.get_context("spawn").Pool(1) as process:
                    row = process.apply(run, (args, data, arm, seed))
                print(row, flush=True)
                made[row.scene, row.arm, row.seed] = row
                write_runs(args.out, asked, list(made.values()))
    print("| scene, seed | " + " | ".join(ARMS) + " |")
    print("| --- |" + " ---: |" * len(ARMS))
    for data in args.data:
        for seed in args.seeds:
            psnrs = [f"{made[data.name, arm, seed].psnr:.2f}" for arm in ARMS]
            print(f"| {data.name}, {seed} | {' | '.join(psnrs)} |")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
