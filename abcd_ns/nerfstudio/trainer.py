"""nerfstudio's trainer, with checkpoints that a run can truly go on from, and an end that loses nothing."""

import os
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from nerfstudio.configs.base_config import ViewerConfig
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from nerfstudio.engine.trainer import TRAIN_INTERATION_OUTPUT, Trainer, TrainerConfig

from abcd_ns.data.input_errors import exit_on_user_error, print_error, say
from abcd_ns.engine.events import Event, LayersDrawn, Pruning, WorkersSeen
from abcd_ns.engine.gaussians.adam import Adam
from abcd_ns.engine.store import ParameterStore, StoreError, crash_points
from abcd_ns.engine.store.atomic import TEMPORARY_SUFFIX, fsync_folder, replacing
from abcd_ns.errors import UserError
from abcd_ns.nerfstudio.flags import AbcdMachineConfig, AbcdViewerConfig, as_a_command, hidden, opened, shown
from abcd_ns.nerfstudio.inspection import inspect, splats_to_begin_with
from abcd_ns.nerfstudio.options import UNUSED, check_options
from abcd_ns.nerfstudio.pipeline import AbcdPipeline, AbcdPipelineConfig
from abcd_ns.nerfstudio.run.resuming import check_start, find_start, has_begun, pin_name
from abcd_ns.nerfstudio.run.settings import flat_options
from abcd_ns.nerfstudio.run.stopping import Stopped, StopSignals, at_once, command_to_resume, next_steps
from abcd_ns.run import STATE, STORE
from abcd_ns.run.fit import device_budget, fit_run
from abcd_ns.run.store import Start
from abcd_ns.terminal import many
from abcd_ns.viewer.guard import THIS_MACHINE, WILDCARDS


@hidden("max_norm", "fused")
@dataclass
class FusedAdamConfig(AdamOptimizerConfig):
    """Adam as 3DGS uses it, one pass over memory for each parameter."""

    _target: type = Adam
    fused: bool = True
    """Update a parameter and its moments in one kernel."""


def on_this_machine(viewer: ViewerConfig, arguments: Sequence[str]) -> ViewerConfig:
    """The viewer's options, on this machine alone unless the command line names a host: by default, ns-viewer
    listens on all networks."""
    flags = ("--viewer.websocket-host", "--viewer.websocket_host")
    named = any(argument.partition("=")[0] in flags for argument in arguments)
    if named or viewer.websocket_host not in WILDCARDS:
        return viewer
    return replace(viewer, websocket_host=THIS_MACHINE)


@shown(
    "data", "max_num_iterations", "output_dir", "experiment_name", "load_dir", "steps_per_save", "vis",
    "pipeline", "machine", "viewer",
)  # fmt: skip
@hidden(*UNUSED)
@dataclass
class AbcdTrainerConfig(TrainerConfig):
    """nerfstudio's trainer with ABCD's checkpoints; moves to the CPU where there is no GPU."""

    _target: type = field(default_factory=lambda: AbcdTrainer)
    data: Path | None = None
    """Folder of photos with a COLMAP model or a transforms.json, or such a .json file."""
    max_num_iterations: int = 30_000
    """Steps of the whole run, those before it was resumed included. All schedules are shares of it."""
    output_dir: Path = Path("outputs")
    """The run's files go to a folder in this one."""
    experiment_name: str | None = None
    """Name of the scene in the outputs; None takes that of its folder."""
    load_dir: Path | None = None
    """Resume the run in this folder."""
    steps_per_save: int = 2000
    """Steps between checkpoints, which nerfstudio's other commands open."""
    pipeline: AbcdPipelineConfig = field(default_factory=AbcdPipelineConfig)
    """What the run may take: time, blocks, memory, workers."""
    machine: AbcdMachineConfig = field(default_factory=AbcdMachineConfig)
    """What trains, and by which random numbers."""
    viewer: AbcdViewerConfig = field(default_factory=partial(AbcdViewerConfig, websocket_host=THIS_MACHINE))
    """The viewer in a browser."""

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "viewer" and "viewer" in self.__dict__:
            value = on_this_machine(value, sys.argv)
        super().__setattr__(name, value)

    def set_experiment_name(self) -> None:
        """As nerfstudio's, which gives no name to `.`, and leaves the output folder by that of `..`."""
        data = self.pipeline.datamanager.data
        if self.experiment_name is None and data is not None:
            self.experiment_name = Path(os.path.abspath(data.parent if data.is_file() else data)).stem or None
        super().set_experiment_name()

    def get_base_dir(self) -> Path:
        """As nerfstudio's; of a run that a command opens, where its config.yml is by now."""
        config = opened(sys.argv)
        return super().get_base_dir() if config is None else config.parent

    def get_checkpoint_dir(self) -> Path:
        """As nerfstudio's; a command that opens a run without checkpoints ends in one line."""
        folder = super().get_checkpoint_dir()
        with as_a_command():
            if opened(sys.argv) is not None and not any(folder.glob("step-*.ckpt")):
                raise UserError(
                    f"{folder} has no checkpoint: resume the run until it saves one, or copy it all."
                )
        return folder

    def print_to_terminal(self) -> None:
        """One line instead of nerfstudio's some hundred; all of it is in config.yml."""
        pipeline = self.pipeline
        what = f"{self.method_name} on {pipeline.datamanager.reader().data}"
        blocks = {0: "as few blocks as fit", 1: "1 block"}.get(pipeline.blocks, f"{pipeline.blocks} blocks")
        seconds = "" if pipeline.max_seconds is None else f", at most {pipeline.max_seconds:g} s"
        say(f"{what}: {blocks}, {self.max_num_iterations:,} steps{seconds}")

    def save_config(self) -> None:
        """Check what can be checked within seconds, then save; the first thing `ns-train` writes."""
        with at_once(partial(say, "Stopped before anything was written.")):
            self.check()
        try:
            super().save_config()
        except OSError as error:
            place = error.filename or self.get_base_dir()  # a full disk names no file
            print_error(f"{place} cannot be made: {error.strerror}. Choose another --output-dir.")
            raise SystemExit(2) from None

    def check(self) -> None:
        """Choose the device, and check options, folder, what is resumed and data before anything is written.
        Exits with code 2 and one line for each fault that the user can repair."""
        device = self.machine.device_type
        if device == "mps" or (device == "cuda" and not torch.cuda.is_available()):
            self.machine.device_type = "cpu"
            why = "No CUDA device was found" if device == "cuda" else "MPS devices are not supported"
            say(f"{why}: training on the CPU.")
        with exit_on_user_error():
            start, pipeline, model = find_start(self), self.pipeline, self.pipeline.model
            check_start(start, self.get_base_dir() / STATE / STORE, pipeline.blocks)
            check_options(self)
            if start and start.step > self.max_num_iterations:
                raise UserError(
                    f"The run is at step {start.step:,} already: give --max-num-iterations above that."
                )
            found = inspect(pipeline.datamanager.reader())
            say(found.in_words())
            if start:  # before its config.yml is replaced
                with ParameterStore.open(start.store, start.pin, read_only=True) as store:
                    found.made_for(pipeline.training).check(store)
            elif not (model.random_init or model.init_splats):
                found.check_seen()
            splats = 0 if start else splats_to_begin_with(model, pipeline.training, found)
            if pipeline.blocks == 0:
                points = splats or (0 if model.random_init else found.points) or model.num_random
                device = torch.device(self.machine.device_type)
                budget = device_budget(pipeline.device_budget_gb, device)
                fit_run(pipeline, budget, found.pixels, found.factor, points, device.type == "cpu")


class AbcdTrainer(Trainer):
    """Saves the merged scene for nerfstudio's tools and pins the same moment in the parameter store.

    Upstream, resuming drops Adam's state and trains all steps again; here it continues at the same step of
    the same visit. Ctrl-C and SIGTERM commit before the process ends.
    """

    config: AbcdTrainerConfig
    pipeline: AbcdPipeline
    resumed_from: Start | None = None
    _trains: int | None = None
    """The thread that trains."""

    def __init__(self, config: AbcdTrainerConfig, *args: Any, **kwargs: Any) -> None:
        super().__init__(config, *args, **kwargs)
        self.total_steps = config.max_num_iterations  # steps of the whole run, those before a resume included
        config.pipeline.training.seed = config.machine.seed
        self.asked = flat_options(config)  # the options as given, by dotted name: `config` is changed later
        self._signals = StopSignals()

    @property
    def folder(self) -> Path:
        """ABCD's own, in the run's folder."""
        return self.base_dir / STATE

    @property
    def training_state(self) -> str:
        """Set by the viewer's buttons. No time counts while nerfstudio's loop reads "paused"."""
        if self._training_state == "paused" and threading.get_ident() == self._trains:
            self.pipeline.coordinator.pause()
        return self._training_state

    @training_state.setter
    def training_state(self, state: str) -> None:
        self._training_state = state

    def setup(self, *args: Any, **kwargs: Any) -> None:
        """As nerfstudio's; what the user can repair ends the process with one line and code 2."""
        with at_once(partial(self._say_end, "Stopped before training began.")), exit_on_user_error():
            super().setup(*args, **kwargs)
        if self.resumed_from:  # later ones are of steps that it went back from
            newest = pin_name(max(self.resumed_from.step - 1, 0))
            self._drop_checkpoints(lambda name: name > newest)
        self.pipeline.coordinator.announce.subscribe(self._may_stop)
        at = TrainingCallbackLocation
        hold = TrainingCallback([at.BEFORE_TRAIN_ITERATION], lambda step: self._signals.hold())  # noqa: ARG005
        release = TrainingCallback([at.AFTER_TRAIN_ITERATION], lambda step: self._signals.release())  # noqa: ARG005
        after = TrainingCallback([at.AFTER_TRAIN], lambda step: self._say_what_is_next())  # noqa: ARG005
        self.callbacks = [hold, *self.callbacks, release, after]

    def train(self) -> None:
        """As nerfstudio's; a signal, or what the user can repair, ends the process and says how to resume."""
        self._trains = threading.get_ident()
        with at_once(partial(self._say_end, "Stopped at once; what was written until then is safe.")):
            self._train()

    def _train(self) -> None:
        try:
            with self._signals:
                self._complete()
                super().train()
        except Stopped as stopped:
            with exit_on_user_error():
                self._save_at_stop()
            self._end_report()
            name, step = stopped.received.name, self.pipeline.coordinator.state.step
            self._say_end(f"Stopped by {name} after step {step:,} of {self.total_steps:,}; nothing is lost.")
            raise SystemExit(128 + stopped.received) from None  # as shells expect
        except (UserError, torch.cuda.OutOfMemoryError) as error:
            self._end_report()
            print_error(str(error) if isinstance(error, UserError) else self._memory_is_full())
            try:
                self.pipeline.coordinator.scene.flush()
            except StoreError as refused:
                if not isinstance(error, StoreError):
                    print_error(str(refused))
            self._say_end()
            raise SystemExit(2) from None
        except Exception:
            with suppress(StoreError):  # the first error matters
                self.pipeline.coordinator.scene.flush()
            raise
        finally:
            self.pipeline.coordinator.dismiss()

    def _save_at_stop(self) -> None:
        """Save at once, since a stopped process may be killed; then again, with visits under way."""
        coordinator = self.pipeline.coordinator
        coordinator.save()
        if coordinator.state.in_flight:
            say("Visits under way are being finished; another Ctrl-C drops them.")
        if coordinator.await_visits():
            coordinator.save()

    def _complete(self) -> None:
        """Finish a run that has had its steps or seconds, but not all that comes after."""
        if self.pipeline.coordinator.progress >= 1.0:
            self._signals.hold()
            with self.train_lock:
                self.pipeline.coordinator.complete()
            self._signals.release()
            self.config.max_num_iterations = 0

    def _memory_is_full(self) -> str:
        run = self.pipeline.coordinator.run
        limit = run.limits.of_block(run.blocks)
        room = f"blocks of {limit:,} Gaussians" if limit else many(run.blocks, "block", "blocks")
        return (
            f"The device's memory does not hold {room}. Nothing that a visit has finished is lost: go on "
            "with --pipeline.blocks 0 and a smaller --pipeline.device-budget-gb, or begin anew with smaller "
            "photos."
        )

    def train_iteration(self, step: int) -> TRAIN_INTERATION_OUTPUT:
        """As nerfstudio's, without graphs, which no log needs; where workers train, one's doing counts."""
        coordinator = self.pipeline.coordinator
        if coordinator.trains_elsewhere:
            coordinator.await_step()
            return torch.zeros(()), {}, {}
        loss, losses, metrics = super().train_iteration(step)
        return loss.detach(), {name: value.detach() for name, value in losses.items()}, metrics

    def _train_complete_viewer(self) -> None:
        # All is saved; nerfstudio goes on serving its viewer until Ctrl-C, which is how such a run ends.
        with suppress(Stopped):
            super()._train_complete_viewer()

    def _may_stop(self, event: Event) -> None:
        # These may take long, and nothing could be lost meanwhile.
        if isinstance(event, (LayersDrawn, Pruning, WorkersSeen)):
            self._signals.check()

    def _end_report(self) -> None:
        self._training_state = "training"  # it was not completed, so nothing is scored, or not again
        for callback in self.callbacks:
            callback.run_callback_at_location(self.step, location=TrainingCallbackLocation.AFTER_TRAIN)

    def _say_end(self, said: str | None = None) -> None:
        """Say that the run ended, and the command that resumes it if there is one."""
        if said is not None:
            say(said)
        command = command_to_resume(sys.argv, self.config.method_name, self.checkpoint_dir)
        if command is not None and has_begun(self.folder / STORE):
            say(f"To go on:\n  {command}")

    def _say_what_is_next(self) -> None:
        over = self.pipeline.coordinator.finished and self._training_state == "completed"
        if over and not self.config.viewer.quit_on_train_completion:  # else a script goes on
            folder, method, twice = self.checkpoint_dir, self.config.method_name, self._twice_as_long()
            longer = command_to_resume(sys.argv, method, folder, twice)
            say(next_steps(self.base_dir, self.config.pipeline.datamanager.reader().data, longer))

    def _twice_as_long(self) -> tuple[str, str]:
        """The option that ended the run, with twice its value."""
        seconds, steps = self.config.pipeline.max_seconds, self.total_steps
        if seconds is not None and self.pipeline.coordinator.state.step < steps:
            return "--pipeline.max-seconds", f"{2 * seconds:g}"
        return "--max-num-iterations", str(2 * steps)

    def _load_checkpoint(self) -> None:
        start = find_start(self.config)
        if start is None:
            say("Training from scratch.")
            return
        self.resumed_from = start
        self._start_step = start.step
        self.config.max_num_iterations = max(self.total_steps - start.step, 0)
        self.step = start.step - 1
        which = "where it was left" if start.pin is None else start.pin
        say(f"Going on after step {start.step:,} of {self.total_steps:,}: {start.store}, {which}")
        if self.config.pipeline.model.init_splats is not None:
            say("--pipeline.model.init-splats begins a run only; this one resumes with its own Gaussians.")

    def _update_viewer_state(self, step: int) -> None:
        """As nerfstudio's, but a client that goes away, or sends nonsense, does not end the run."""
        try:
            super()._update_viewer_state(step)
        except (ArithmeticError, AssertionError, AttributeError, LookupError, TypeError, ValueError) as error:
            say(f"The viewer failed at step {step} ({error!r}); training goes on.")

    def save_checkpoint(self, step: int) -> None:
        """Save the merged scene for nerfstudio's tools, and everything else in the store. A UserError if the
        disk refuses; the run can still be resumed."""
        coordinator = self.pipeline.coordinator
        coordinator.pause()
        # Steps of workers are counted here one by one, but committed visit by visit.
        step = max(coordinator.state.step - 1, 0)
        coordinator.save(pin=pin_name(step))
        crash_points.reached(crash_points.CHECKPOINT_PINNED)
        path = self.checkpoint_dir / f"{pin_name(step)}.ckpt"
        # The Adam moments of all blocks are in the store; nerfstudio expects the keys.
        state = {"optimizers": {}, "schedulers": {}, "scalers": self.grad_scaler.state_dict()}
        _save_atomically({"step": step, "pipeline": self.pipeline.state_dict(), **state}, path)
        crash_points.reached(crash_points.CHECKPOINT_IN_PLACE)
        if self.config.save_only_latest_checkpoint:
            self._drop_checkpoints(lambda name: name != path.stem)

    def _drop_checkpoints(self, dropped: Callable[[str], bool]) -> None:
        """Remove checkpoints and pins by their names, which sort by step."""
        for path in self.checkpoint_dir.glob("step-*.ckpt"):
            if dropped(path.stem):
                path.unlink(missing_ok=True)
        store = self.pipeline.coordinator.scene.store
        for pin in filter(dropped, store.pins):
            store.unpin(pin)


def _save_atomically(state: dict[str, Any], path: Path) -> None:
    """Put a checkpoint in place of `path`, wholly or not at all; a UserError if the disk refuses."""
    run = path.parent.parent  # nerfstudio takes every file beside it for a checkpoint
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for leftover in run.glob(f".step-*.ckpt*{TEMPORARY_SUFFIX}"):  # of a run that was killed
            leftover.unlink(missing_ok=True)
        with replacing(path, run) as temporary:
            torch.save(state, temporary)
            crash_points.reached(crash_points.CHECKPOINT_WRITTEN)
        fsync_folder(path.parent)
    except (OSError, RuntimeError) as error:  # torch raises the latter for a full disk
        raise UserError(f"{path} could not be written: {error}. Free space; the store is safe.") from error
