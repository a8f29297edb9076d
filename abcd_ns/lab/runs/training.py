"""A training run that is watched: its clock, its curve of held-out quality, and what it reports of itself."""

import time
from collections.abc import Callable

from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.engine.trainer import Trainer

from abcd_ns.engine.events import Event, HeldOutScored, StepTaken, VisitEnded
from abcd_ns.engine.train.run_state import Budget, Stopwatch
from abcd_ns.lab.job import Settings
from abcd_ns.lab.results.run import CurvePoint
from abcd_ns.lab.runs.evaluate import mean_psnr


class CurveRecorder:
    """Scores the held-out views at given moments of a run, while the run's stopwatch is paused.

    Args:
        moments: shares of the run, rising; 1 and above are left to whoever ends the run.
        pause: stops the stopwatch, unless training goes on meanwhile.
        progress: the share of the run that is done.
        steps: optimisation steps taken.
        measure: the score, dB.
        count: Gaussians that are drawn.
    """

    def __init__(
        self,
        moments: tuple[float, ...],
        stopwatch: Stopwatch,
        pause: Callable[[], None],
        progress: Callable[[], float],
        steps: Callable[[], int],
        measure: Callable[[], float],
        count: Callable[[], int],
    ) -> None:
        self.points: list[CurvePoint] = []
        self.seconds = 0.0
        """Spent on evaluation."""
        self._left = [moment for moment in moments if moment < 1]
        self._stopwatch, self._progress, self._steps = stopwatch, progress, steps
        self._pause = pause
        self._measure, self._count = measure, count

    def look(self) -> None:
        """Call after every step."""
        progress = self._progress()
        if progress >= 1 or not self._left or progress < self._left[0]:
            return
        self._left = [moment for moment in self._left if moment > progress]
        self._pause()
        began = time.perf_counter()
        seconds, steps = self._stopwatch.seconds, self._steps()
        self.points.append(CurvePoint(seconds, steps, self._measure(), self._count()))
        self.seconds += time.perf_counter() - began
        self._stopwatch.start()


class Training:
    """A trainer that is set up, with a curve recorder in it."""

    def __init__(self, trainer: Trainer, settings: Settings) -> None:
        self.trainer, self.pipeline = trainer, trainer.pipeline
        self.layer_seconds, self._steps = 0.0, 0
        self.coordinator = getattr(trainer.pipeline, "coordinator", None)
        ours = self.coordinator is not None
        self.stopwatch = self.coordinator.stopwatch if ours else Stopwatch()
        self._budget = Budget(settings.steps, settings.seconds)
        self.recorder = CurveRecorder(
            settings.moments,
            self.stopwatch,
            self.coordinator.pause if ours else self.stopwatch.pause,
            lambda: self.progress,
            lambda: self.steps,
            self._score_aloud if ours else lambda: mean_psnr(self.pipeline),
            lambda: self.gaussians,
        )
        if ours:
            self.coordinator.announce.subscribe(self._listen)
        else:
            self._follow_steps()

    def _listen(self, event: Event) -> None:
        if isinstance(event, VisitEnded):
            self.layer_seconds += event.layer_seconds
        if isinstance(event, (StepTaken, VisitEnded)):
            self.recorder.look()

    def _score_aloud(self) -> float:
        found = mean_psnr(self.pipeline)
        self.coordinator.announce(HeldOutScored(found, None))
        return found

    def _follow_steps(self) -> None:
        """For a trainer that is not ABCD's: count the time here, and stop when it is up."""

        def begin_step(step: int) -> None:  # noqa: ARG001 - nerfstudio passes it
            self.stopwatch.start()

        def end_step(step: int) -> None:
            self._steps = step + 1  # the trainer's own count is one higher once it has been stopped
            self.recorder.look()
            if self.progress >= 1:
                self.stopwatch.pause()
                self.trainer.stop_training = True

        location = TrainingCallbackLocation
        self.trainer.callbacks += [
            TrainingCallback([location.BEFORE_TRAIN_ITERATION], begin_step),
            TrainingCallback([location.AFTER_TRAIN_ITERATION], end_step),
        ]

    def warm_up(self) -> None:
        """Compile what will be drawn with, before the clock runs."""
        if self.coordinator is None:
            return
        self.pipeline.model.draws_with().warm_up()

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
