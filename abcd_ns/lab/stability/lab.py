"""What a scenario is; small scenes trained without nerfstudio, the same way for every method."""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.gaussians.initialize import cloud_from_points
from abcd_ns.engine.gaussians.param_swap import nothing_active
from abcd_ns.engine.render.cpu.backend import TorchRasterizer
from abcd_ns.engine.render.loss import psnr
from abcd_ns.engine.space.distances import as_trained
from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.train.coordinator import Coordinator
from abcd_ns.engine.train.density.control import DensityConfig
from abcd_ns.engine.train.recipe import Recipe
from abcd_ns.engine.train.run_state import Budget
from abcd_ns.engine.train.step.batch import Sample, Target
from abcd_ns.engine.train.training_loop import train_step
from abcd_ns.engine.types import NEAR_PLANE, Crop, Gaussians, View
from abcd_ns.lab.world.world import TABLE, World, ring
from abcd_ns.run import STORE
from abcd_ns.run.begin import Capture, begin_run
from abcd_ns.run.options import RunOptions

Method = Literal["abcd", "abcd-ablated", "abcd-monolithic"]
METHODS: tuple[Method, ...] = ("abcd", "abcd-ablated", "abcd-monolithic")
PAIR: tuple[Method, ...] = ("abcd", "abcd-monolithic")
SH_DEGREE = 1  # nothing in these worlds shines
LIMITED = DensityConfig(max_gaussians=1000)  # as many Gaussians for every method, and few, for time
BUDGET = 600  # steps of a run where methods are compared: few, so that what blocks cost shows
BLOCKS = 4


@dataclass(frozen=True)
class Stage:
    """What a capture gives: photos to train on, photos held out, points to begin with."""

    views: list[View]
    photos: dict[int, Float[Tensor, "h w 3"]]  # by the view's index
    points: Float[Tensor, "n 3"]
    colors: Float[Tensor, "n 3"]  # 0..255
    held_out: list[View]
    truth: list[Float[Tensor, "h w 3"]]  # their photos

    def __call__(self, index: int, crop: Crop) -> Float[Tensor, "h w 3"]:
        """The training loop's photo reader."""
        return self.photos[index][crop.slices]

    def target(self, sample: Sample) -> Target:
        """What a sample is trained on, without a mask."""
        return sample.reduced(self(sample.view.index, sample.source)), None

    def capture(self, sh_degree: int) -> Capture:
        """What a run of this degree is trained on; it begins with a Gaussian for each point."""
        names = [Path(str(view.index)) for view in self.views]
        start = partial(cloud_from_points, self.points.float(), self.colors, sh_degree=sh_degree)
        return Capture(self.views, names, self.target, start, len(self.points))

    def only(self, count: int) -> "Stage":
        """With `count` of the training views, evenly spread."""
        total = len(self.views)
        return replace(self, views=[self.views[k * total // count] for k in range(count)])


def make_stage(
    world: World = TABLE,
    views: list[View] | None = None,
    held_out: list[View] | None = None,
    points: int = 400,
) -> Stage:
    """Photograph a world; on a ring of 16 cameras unless told otherwise, held out between them."""
    views = ring(16) if views is None else views
    held_out = ring(8, turn=0.17) if held_out is None else held_out
    where, colors = world.points(views, points)
    views = as_trained(views, where, NEAR_PLANE)
    photos = {view.index: world.photo(view) for view in views}
    return Stage(views, photos, where, colors, held_out, [world.photo(view) for view in held_out])


class Trained(NamedTuple):
    """What a run left behind."""

    gaussians: Gaussians  # the whole scene in one list
    psnr: float  # held-out, dB


class Lab:
    """Where scenarios are carried out: a folder for stores, a rasterizer, and the seed of every training that
    names none."""

    def __init__(self, folder: Path, seed: int = 0) -> None:
        self.seed, self._folder, self.rasterizer = seed, folder, TorchRasterizer()
        self._scores: dict[Method, float] = {}

    def coordinator(
        self,
        stage: Stage,
        method: Method = "abcd",
        *,
        budget: int = BUDGET,
        blocks: int = BLOCKS,
        partition: Literal["kd", "grid"] = "kd",
        **training: Any,
    ) -> Coordinator:
        """A run of `budget` steps that begins, in a new store, with `training` as options of TrainingConfig.
        Nearly all steps draw one view, as blocks are under-trained here."""
        usual = {"recipe": Recipe(layers=method != "abcd-ablated"), "sh_degree": SH_DEGREE}
        config = TrainingConfig(**{**usual, "seed": self.seed, **training})
        blocks = 1 if method == "abcd-monolithic" else blocks
        options = RunOptions(config, blocks=blocks, partition=partition, workers=1)
        folder = Path(tempfile.mkdtemp(dir=self._folder)) / STORE
        empty = nothing_active(SH_DEGREE)
        capture, steps, device = stage.capture(SH_DEGREE), Budget(steps=budget), torch.device("cpu")
        return begin_run(options, capture, device, folder, steps, self.rasterizer, *empty, say=lambda _: None)

    def train(self, stage: Stage, method: Method, **options: Any) -> Trained:
        """Train on a stage under the conditions of comparisons: as few steps and Gaussians for every method.
        `options` of `coordinator` go before these."""
        coordinator = self.coordinator(stage, method, **{"density": LIMITED, **options})
        while not coordinator.finished:
            train_step(coordinator, stage)
        gaussians = coordinator.scene.everything("cpu")
        return Trained(gaussians, self.score(gaussians, stage))

    def score_of_table(self, method: Method) -> float:
        """Held-out PSNR on the table, dB; trained once for all scenarios."""
        if method not in self._scores:
            self._scores[method] = self.train(make_stage(), method).psnr
        return self._scores[method]

    @torch.no_grad()
    def pictures(self, gaussians: Gaussians, views: list[View]) -> list[Float[Tensor, "h w 3"]]:
        """Merged pictures on black, 0..1."""
        degree = gaussians.sh_degree
        return [self.rasterizer(gaussians, view, sh_degree=degree).color.clamp(0, 1) for view in views]

    def score(self, gaussians: Gaussians, stage: Stage) -> float:
        """Mean PSNR of merged pictures of the held-out views, dB."""
        drawn = self.pictures(gaussians, stage.held_out)
        return sum(float(psnr(a, b)) for a, b in zip(drawn, stage.truth, strict=True)) / len(drawn)


@dataclass(frozen=True)
class Finding:
    """What a scenario found out."""

    passed: bool  # by ABCD, under the scenario's rule
    said: dict[str, str]  # by method, what it did, in a few words
    numbers: dict[str, float] = field(default_factory=dict)  # what the rule was applied to, by name; finite
    worse: bool = False  # whether ABCD did worse than one block, whatever the rule says


@dataclass(frozen=True)
class Scenario:
    """One way in which methods fail."""

    id: str
    fails: str  # what happens elsewhere
    done: str  # what is done here to make it happen
    rule: str  # what passes
    run: Callable[[Lab], Finding]
