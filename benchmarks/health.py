"""What each rule of health is worth: held-out PSNR at fixed steps with all rules, without one, with none.

    python -m benchmarks.health --data castle-P30 fox --steps 500 --seeds 0 1 --out FILE

Rules that mend what is no number are always on: without them such a run is lost, as `abcd stability` shows.
Every run has a process and one thread of its own. Runs of ns-train's trainer.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import tyro

from abcd_ns.engine.train.health import health
from abcd_ns.lab.results.tables import markdown
from abcd_ns.lab.runs.evaluate import mean_psnr
from benchmarks.runs import Asked, runs_of, trainer_alone


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


@dataclass(kw_only=True)
class Args(Asked):
    """What to compare."""

    data: tuple[Path, ...]
    """The scenes, as of ns-train."""
    seeds: tuple[int, ...] = (0, 1)
    """A run of each arm for each. Runs that `out` has are not made again."""


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


def run(args: Args, scene: str, arm: str, seed: int) -> Row:
    """Train and look at held-out views."""
    ARMS[arm]()
    data = next(path for path in args.data if path.name == scene)
    with trainer_alone(data, seed=seed, **args.of_all_runs) as trainer:
        trainer.train()
        coordinator = trainer.pipeline.coordinator
        records = coordinator.state.health.values()
        giants, undone = (sum(getattr(r, name) for r in records) for name in ("giants", "undone"))
        return Row(scene, arm, seed, giants, undone, coordinator.count(), mean_psnr(trainer.pipeline))


def main(args: Args) -> None:
    """Make the runs that are missing, write the file after each, print the table."""
    scenes = [data.name for data in args.data]
    keys = [(scene, arm, seed) for seed in args.seeds for scene in scenes for arm in ARMS]
    rows = runs_of(args.out, args.of_all_runs, Row, keys, partial(run, args))
    table = [["scene, seed", *ARMS]]
    for scene in scenes:
        for seed in args.seeds:
            psnrs = [f"{rows[scene, arm, seed].psnr:.2f}" for arm in ARMS]
            table.append([f"{scene}, {seed}", *psnrs])
    print(markdown(table))


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
