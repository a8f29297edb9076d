"""nerfstudio's trainer, with checkpoints that a run can truly go on from."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from nerfstudio.engine.trainer import Trainer
from nerfstudio.utils.rich_utils import CONSOLE

from abcd_ns.errors import UserError
from abcd_ns.plugin.pipeline import STORE, AbcdPipeline

if TYPE_CHECKING:
    from abcd_ns.plugin.config import AbcdTrainerConfig


class AbcdTrainer(Trainer):
    """Saves the merged scene for nerfstudio's tools and pins the same moment in the parameter store.

    Upstream, resuming drops Adam's state and trains the full count of steps again; here it goes on at the
    very step and within the visit that was under way.
    """

    config: "AbcdTrainerConfig"
    pipeline: AbcdPipeline
    resumed_from: tuple[Path, str] | None = None
    """Folder and pin of the store that this run goes on from."""

    def __init__(self, config: "AbcdTrainerConfig", *args: Any, **kwargs: Any) -> None:
        super().__init__(config, *args, **kwargs)
        self.total_steps = config.max_num_iterations
        """Steps of the whole run, those before a resume included."""

    def _load_checkpoint(self) -> None:
        path = self._checkpoint_to_load()
        if path is None:
            CONSOLE.print("Training from scratch.")
            return
        step = int(torch.load(path, map_location="cpu", weights_only=True)["step"])
        store = path.parent.parent / "abcd" / STORE
        if not store.is_dir():
            raise UserError(f"{path} can be viewed but not trained further: the folder {store} is missing.")
        self.resumed_from = (store, pin_name(step))
        self._start_step = step + 1
        self.config.max_num_iterations = max(self.total_steps - self._start_step, 0)
        self.step = step
        CONSOLE.print(f"Going on after step {step + 1} of {self.total_steps} from {path}")

    def _update_viewer_state(self, step: int) -> None:
        """As nerfstudio's, which lets a client that goes away, or sends nonsense, end the run."""
        try:
            super()._update_viewer_state(step)
        except (ArithmeticError, AssertionError, AttributeError, LookupError, TypeError, ValueError) as error:
            CONSOLE.print(f"The viewer failed at step {step} ({error!r}); training goes on.", markup=False)

    def _checkpoint_to_load(self) -> Path | None:
        config = self.config
        if config.load_dir is None:
            return config.load_checkpoint
        found = sorted(config.load_dir.glob("step-*.ckpt"))
        if config.load_step is not None:
            found = [config.load_dir / f"step-{config.load_step:09d}.ckpt"]
        if not found or not found[-1].exists():
            raise UserError(f"There is no checkpoint step-*.ckpt in {config.load_dir}.")
        return found[-1]

    def save_checkpoint(self, step: int) -> None:
        """Save the merged scene for nerfstudio's tools, and everything else in the store."""
        coordinator = self.pipeline.coordinator
        if coordinator is None:
            raise RuntimeError("there is nothing to save before training has begun")
        coordinator.stopwatch.pause()
        coordinator.save(pin=pin_name(step))
        self.checkpoint_dir.mkdir(parents=True, exist_ok=True)
        path = self.checkpoint_dir / f"step-{step:09d}.ckpt"
        # The Adam moments of all blocks are in the store; nerfstudio expects the keys.
        state = {"optimizers": {}, "schedulers": {}, "scalers": self.grad_scaler.state_dict()}
        _save_atomically({"step": step, "pipeline": self.pipeline.state_dict(), **state}, path)
        if self.config.save_only_latest_checkpoint:
            self._forget_all_but(path)

    def _forget_all_but(self, kept: Path) -> None:
        store = self.pipeline.coordinator.scene.store
        for old in self.checkpoint_dir.glob("step-*.ckpt"):
            if old != kept:
                old.unlink()
        for pin in store.pins:
            if pin != kept.stem:
                store.unpin(pin)


def pin_name(step: int) -> str:
    """The store's pin that belongs to a checkpoint: its file name without the ending."""
    return f"step-{step:09d}"


def _save_atomically(state: dict[str, Any], path: Path) -> None:
    # Not named step-*: nerfstudio takes every such file for a checkpoint.
    temporary = path.parent.parent / f".{path.name}.tmp"
    torch.save(state, temporary)
    with open(temporary, "rb") as file:
        os.fsync(file.fileno())
    os.replace(temporary, path)
