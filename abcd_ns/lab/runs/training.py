"""A training run that is watched: its clock, its curve of held-out quality, and what it reports of itself."""

import time

from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.engine.trainer import Trainer

from abcd_ns.engine.events import Event, HeldOutScored, StepTaken, VisitEnded
from abcd_ns.engine.train.run_state import Budget, Stopwatch
from abcd_ns.lab.job import Settings
from abcd_ns.lab.results.run import CurvePoint
from abcd_ns.lab.runs.evaluate import mean_psnr


class Training:
    """A trainer that is set up, whose held-out views are scored at the settings' moments of the run.

    The run's stopwatch is paused meanwhile. The end is left to whoever ends the run.
    """

    def __init__(self, trainer: Trainer, settings: Settings) -> None:
        self.trainer, self.pipeline = trainer, trainer.pipeline
        self.layer_seconds, self._steps = 0.0, 0
        self.coordinator = getattr(trainer.pipeline, "coordinator", None)
        ours = self.coordinator is not None
        self.stopwatch = self.coordinator.stopwatch if ours else Stopwatch()
        self._budget = Budget(settings.steps, settings.seconds)
        self._pause = self.coordinator.pause if ours else self.stopwatch.pause
        self._resume = self.coordinator.resume if ours else self.stopwatch.start
        self.points: list[CurvePoint] = []
        self.seconds_of_looks = 0.0
        """Spent on evaluation."""
        self._moments = [moment for moment in settings.moments if moment < 1]
        if ours:
            self.coordinator.announce.subscribe(self._listen)
        else:
            self._follow_steps()

    def _listen(self, event: Event) -> None:
        if isinstance(event, VisitEnded):
            self.layer_seconds += event.layer_seconds
        if isinstance(event, (StepTaken, VisitEnded)):
            self._look()

    def _look(self) -> None:
        """After every step: score, if the next moment has come."""
        progress = self.progress
        if progress >= 1 or not self._moments or progress < self._moments[0]:
            return
        self._moments = [moment for moment in self._moments if moment > progress]
        self._pause()
        began, seconds, steps = time.perf_counter(), self.stopwatch.seconds, self.steps
        found = mean_psnr(self.pipeline)
        if self.coordinator is not None:
            self.coordinator.announce(HeldOutScored(found, None))
        self.points.append(CurvePoint(seconds, steps, found, self.gaussians))
        self.seconds_of_looks += time.perf_counter() - began
        self._resume()

    def _follow_steps(self) -> None:
        """For a trainer that is not ABCD's: count the time here, and stop when it is up."""

        def begin_step(step: int) -> None:  # noqa: ARG001 - nerfstudio passes it
            self.stopwatch.start()

        def end_step(step: int) -> None:
            self._steps = step + 1  # the trainer's own count is one higher once it has been stopped
            self._look()
            if self.progress >= 1:
                self.stopwatch.pause()
                self.trainer.stop_training = True

        location = TrainingCallbackLocation
        self.trainer.callbacks += [
            TrainingCallback([location.BEFORE_TRAIN_ITERATION], begin_step),
            TrainingCallback([location.AFTER_TRAIN_ITERATION], end_step),
        ]

    @property
    def progress(self) -> float:
        """The share of the run that is done."""
        if self.coordinator is None:
            return self._budget.progress(self.steps, self.stopwatch.seconds)
        return self.coordinator.progress

    @property
    def steps(self) -> int:
        """Optimisation steps taken."""
        return self._steps if self.coordinator is None else self.coordinator.state.step

    @property
    def blocks(self) -> int:
        """1 where the method knows of none."""
        return 1 if self.coordinator is None else self.coordinator.scene.tree.num_blocks

    @property
    def gaussians(self) -> int:
        """In the whole scene."""
        return self.pipeline.model.num_points if self.coordinator is None else self.coordinator.count()

    @property
    def parameters(self) -> int:
        """Of how many numbers those are."""
        if self.coordinator is not None:
            return self.coordinator.scene.parameters()
        return sum(values.numel() for values in self.pipeline.model.gauss_params.values())
