"""One run in a process of its own: `python -m abcd_ns.lab.runs.worker JOB.json`.

Reads a job, trains as `ns-train` does, and writes run.json and pictures beside the job. Whatever it prints is
the run's log; its last line tells what went wrong.
"""

import random
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import torch
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.engine.trainer import Trainer
from PIL import Image

from abcd_ns.engine.events import Event, HeldOutScored, StepTaken, VisitBegan, VisitEnded
from abcd_ns.engine.gaussians.param_swap import active_gaussians
from abcd_ns.engine.layers.layer_renderer import default_pass
from abcd_ns.engine.train.memory import DeviceNeeds, frozen_bytes, needs_of_step
from abcd_ns.engine.train.run_state import Budget, Stopwatch
from abcd_ns.engine.train.schedule import evenly
from abcd_ns.errors import UserError
from abcd_ns.formats.scene_file import MOST_AT_ONCE, ply_bytes, spz_bytes
from abcd_ns.lab.job import Job, Settings
from abcd_ns.lab.results.results import CurvePoint, Run, ViewScore
from abcd_ns.lab.runs.configs import trainer_config
from abcd_ns.lab.runs.evaluate import draw_held_out, mean, ordering_gap, to_bytes
from abcd_ns.lab.runs.runner import memory_of_run, work
from abcd_ns.machine import describe_versions, disk_bytes, without_home
from abcd_ns.nerfstudio.metrics import lpips_missing
from abcd_ns.nerfstudio.model import AbcdModel
from abcd_ns.nerfstudio.trainer import AbcdTrainerConfig
from abcd_ns.run import STORE
from abcd_ns.units import bytes_in_words


def run(job: Job, folder: Path) -> Run:
    """Train and score. `folder`, which is `job.folder(out)`, gets nerfstudio's files, and pictures of some
    held-out views. A UserError or SystemExit if the scene or an option cannot be used; said on the
    console."""
    training = set_up(job, folder.parent.parent.parent)
    training.trainer.train()
    budget = getattr(training.trainer.config.pipeline, "gaussian_bytes", 0)
    if budget and training.gaussian_bytes > budget:
        held, given = bytes_in_words(training.gaussian_bytes), bytes_in_words(budget)
        raise UserError(f"Gaussians took {held} of a budget of {given}")
    total = time.time() - psutil.Process().create_time() - training.seconds_of_looks
    memory = memory_of_run()
    scores, gaps = score_held_out(training, job, folder / "pictures")
    names = ("psnr", "ssim", "lpips", "psnr_merged", "ssim_merged")
    means = {name: mean([getattr(view, name) for view in scores]) for name in names}
    gap, note = ordering_gap(gaps, training.blocks)
    end = CurvePoint(training.stopwatch.seconds, training.steps, means["psnr_merged"], training.gaussians)
    return Run(
        method=job.method,
        scene=job.settings.scene,
        seed=job.seed,
        blocks=training.blocks,
        steps=training.steps,
        train_seconds=end.seconds,
        total_seconds=total,
        **means,
        lpips_reason=without_home(lpips_missing() or "") or None,
        ordering_gap_db=gap,
        ordering_gap_note=note,
        gaussians=training.gaussians,
        parameters=training.parameters,
        **file_bytes(training),
        **memory,
        gaussian_bytes=training.gaussian_bytes or None,
        store_bytes=disk_bytes(folder / "abcd" / STORE),
        layer_seconds=training.layer_seconds,
        curve=(*training.points, end),
        views=tuple(scores),
        versions=describe_versions(),
    )


def set_up(job: Job, out: Path) -> "Training":
    """All that comes before the first step; `out` is where the job's folder is."""
    config = trainer_config(job, out)
    if isinstance(config, AbcdTrainerConfig):
        config.check()
    for seed in (random.seed, np.random.seed, torch.manual_seed):  # as `ns-train` does
        seed(job.seed)
    trainer = config.setup(local_rank=0, world_size=1)
    config.save_config()
    trainer.setup()
    return Training(trainer, job.settings)


class Training:
    """A trainer that is set up, whose held-out views are scored at the settings' moments of the run, while
    its stopwatch is paused. The end is left to the caller."""

    def __init__(self, trainer: Trainer, settings: Settings) -> None:
        self.trainer, self.pipeline = trainer, trainer.pipeline
        self.coordinator = getattr(trainer.pipeline, "coordinator", None)
        """None for splatfacto, whose steps and time are counted here."""
        self.points: list[CurvePoint] = []
        self.layer_seconds = self.seconds_of_looks = 0.0
        self.gaussian_bytes = 0
        self._moments = [moment for moment in settings.moments if moment < 1]
        if self.coordinator is not None:
            self.stopwatch = self.coordinator.stopwatch
            self.coordinator.announce.subscribe(self._listen)
            return
        self.stopwatch, self._steps = Stopwatch(), 0
        self._budget = Budget(settings.steps, settings.seconds)
        where = TrainingCallbackLocation
        trainer.callbacks += [
            TrainingCallback([where.BEFORE_TRAIN_ITERATION], lambda step: self.stopwatch.start()),  # noqa: ARG005
            TrainingCallback([where.AFTER_TRAIN_ITERATION], self._end_step),
        ]

    def _listen(self, event: Event) -> None:
        if isinstance(event, VisitEnded):
            self.layer_seconds += event.layer_seconds
        if isinstance(event, (StepTaken, VisitBegan)):
            self._note_held(drawing=isinstance(event, VisitBegan))
        if isinstance(event, (StepTaken, VisitEnded)):
            self._look()

    def _note_held(self, drawing: bool) -> None:
        """Count what is held now; if `drawing`, layers are about to be drawn, and steps have not begun."""
        coordinator = self.coordinator
        config, gaussians = coordinator.config, len(coordinator.params["means"])
        degree = active_gaussians(coordinator.params).sh_degree
        needs = needs_of_step(config, 0, coordinator.batch, degree)
        held = gaussians * needs.gaussian_bytes
        if drawing:  # parameters and their moments, and of others so many as one pass draws
            most = config.limits.pass_gaussians or default_pass(coordinator.scene)
            frozen = min(most, coordinator.count() - gaussians) if config.recipe.layers else 0
            held = gaussians * 3 * needs.parameter_bytes
            held += frozen * frozen_bytes(config.sh_degree, config.primitive)
        self.gaussian_bytes = max(self.gaussian_bytes, held)

    def _end_step(self, step: int) -> None:
        self._steps = step + 1  # the trainer's own count is one higher once it has been stopped
        self.gaussian_bytes = max(self.gaussian_bytes, self.gaussians * DeviceNeeds(0, 1).gaussian_bytes)
        self._look()
        if self.progress >= 1:
            self.stopwatch.pause()
            self.trainer.stop_training = True

    def _look(self) -> None:
        """After every step: score, if the next moment has come."""
        progress = self.progress
        if progress >= 1 or not self._moments or progress < self._moments[0]:
            return
        self._moments = [moment for moment in self._moments if moment > progress]
        (self.coordinator or self.stopwatch).pause()
        began, seconds, steps = time.perf_counter(), self.stopwatch.seconds, self.steps
        found = mean([drawn.psnr for drawn in draw_held_out(self.pipeline, composited=False)])
        self.points.append(CurvePoint(seconds, steps, found, self.gaussians))
        self.seconds_of_looks += time.perf_counter() - began
        if self.coordinator is None:
            self.stopwatch.start()
        else:
            self.coordinator.announce(HeldOutScored(found, None))
            self.coordinator.resume()

    @property
    def progress(self) -> float:
        if self.coordinator is None:
            return self._budget.progress(self.steps, self.stopwatch.seconds)
        return self.coordinator.progress

    @property
    def steps(self) -> int:
        return self._steps if self.coordinator is None else self.coordinator.state.step

    @property
    def blocks(self) -> int:
        """1 where the method knows of none."""
        return 1 if self.coordinator is None else self.coordinator.scene.tree.num_blocks

    @property
    def gaussians(self) -> int:
        return self.pipeline.model.num_points if self.coordinator is None else self.coordinator.count()

    @property
    def parameters(self) -> int:
        """Of how many numbers those are."""
        if self.coordinator is not None:
            return self.coordinator.scene.parameters()
        return sum(values.numel() for values in self.pipeline.model.gauss_params.values())


def file_bytes(training: Training) -> dict[str, int | None]:
    """Of the scene as files; nothing where RAM should not hold it twice."""
    if training.gaussians > MOST_AT_ONCE:
        return {}
    model = training.pipeline.model
    ours = isinstance(model, AbcdModel)
    scene = model.merged() if ours else active_gaussians(model.gauss_params).detach().to("cpu")
    return {"ply_bytes": ply_bytes(scene), "spz_bytes": spz_bytes(scene)}


def score_held_out(training: Training, job: Job, pictures: Path) -> tuple[list[ViewScore], list[float]]:
    """Scores and squared ordering gaps of all held-out views; photo and picture of some of them as PNG."""
    shown = set(evenly(range(len(training.pipeline.datamanager.eval_dataset)), job.settings.pictures))
    scores, gaps = [], []
    for drawn in draw_held_out(training.pipeline):
        scores.append(drawn.score)
        gaps.append(drawn.squared_gap)
        if drawn.row in shown:
            pictures.mkdir(exist_ok=True)
            for kind in ("photo", "merged"):
                Image.fromarray(to_bytes(getattr(drawn, kind))).save(pictures / f"{kind}-{drawn.row:04d}.png")
    return scores, gaps


if __name__ == "__main__":
    sys.exit(work(Job, run))
