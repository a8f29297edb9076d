"""What a finished run says last: what to do with it, and how to train on where it was too short."""

import shlex
import sys
from pathlib import Path

from abcd_ns.engine.train.trainer import Trainer
from abcd_ns.nerfstudio.run.stopping import command_to_resume


def next_steps(trainer: Trainer, method: str, data: Path, checkpoints: Path) -> list[str]:
    """Commands that follow on a run, each below a line that says what it does.

    Args:
        data: as given to `ns-train`.
        checkpoints: the folder of the run's checkpoints, in the run's own.
    """
    run, state = checkpoints.parent, trainer.state
    blocks = trainer.scene.tree.num_blocks
    seen = [block for block in range(blocks) if state.views.get(block) != 0]
    missed = sum(block not in state.health or state.health[block].visits == 0 for block in seen)
    report = ["abcd", "report", str(run), "--data", str(data)]
    steps = {
        "A page about the run:": shlex.join(report),
        "Look around in the scene:": shlex.join(["ns-viewer", "--load-config", str(run / "config.yml")]),
        "A file for other viewers:": shlex.join(["abcd", "export", str(run), "--out", "scene.ply"]),
    }
    longer = command_to_resume(sys.argv, method, checkpoints, _doubled(trainer))
    if longer is not None:
        why = f" {missed} of {blocks} blocks were not visited." if missed and state.visit else ""
        steps[f"Train twice as long.{why}"] = longer
    return [line for what, command in steps.items() for line in (f"  {what}", f"    {command}")]


def _doubled(trainer: Trainer) -> dict[str, object]:
    """The option that ended the run, with twice its value."""
    budget, seconds = trainer.run.budget, trainer.stopwatch.seconds
    if budget.seconds is None or trainer.state.step / budget.steps >= seconds / budget.seconds:
        return {"--max-num-iterations": 2 * budget.steps}
    return {"--pipeline.max-seconds": f"{2 * budget.seconds:g}"}
