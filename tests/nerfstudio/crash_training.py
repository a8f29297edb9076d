"""nerfstudio's trainer in processes that are killed; see tests.reference.crash_runs for the engine's."""

import os
import signal
from pathlib import Path
from typing import Any

import torch

from abcd_ns.engine.events import Event, StepTaken
from abcd_ns.engine.store import crash_points
from tests.nerfstudio.test_training import configure, run
from tests.reference.crash_runs import Kill, Runs, killer

STEPS_PER_SAVE = 10


def train(
    data: Path,
    out: Path,
    kill: Kill | None = None,
    kill_at_step: int | None = None,
    commit_seconds: float = 60.0,
    **options: Any,
):
    """Train as `ns-train` does; the body of a process.

    Args:
        kill, kill_at_step: where it kills itself.
        commit_seconds: as of TrainingConfig.
        options: of the trainer's config.
    """
    from nerfstudio.utils import writer  # which cannot be the first of nerfstudio's modules

    torch.set_num_threads(1)
    writer.EVENT_WRITERS.clear()  # of the process that was forked, whose threads are not here
    if kill is not None:
        crash_points.reached = killer(kill)
    config = configure(data, out, **options)
    config.pipeline.training.commit_seconds = commit_seconds

    def end(event: Event) -> None:
        if isinstance(event, StepTaken) and event.step == kill_at_step:
            os.kill(os.getpid(), signal.SIGKILL)

    run(config, listener=end)


class Trainings(Runs):
    body = staticmethod(train)


def run_folder(out: Path) -> Path:
    (folder,) = out.glob("*/abcd/run")
    return folder


def gaussians(run: Path) -> dict[str, torch.Tensor]:
    """The scene in the run's last checkpoint."""
    newest = sorted((run / "nerfstudio_models").glob("step-*.ckpt"))[-1]
    state = torch.load(newest, weights_only=True)["pipeline"]
    return {name: value for name, value in state.items() if "gauss_params" in name}


def assert_same(run: Path, other: Path) -> None:
    """Two runs' last checkpoints hold the same scene, to the last bit."""
    mine, theirs = gaussians(run), gaussians(other)
    assert mine.keys() == theirs.keys()
    assert all(torch.equal(mine[name], theirs[name]) for name in theirs)
