"""Trains single visits of somebody else's run, on parameters of its own."""

import copy
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import torch
from torch.nn import Parameter

from abcd_ns.cluster.assignment import Drawn, VisitOutcome, VisitTask
from abcd_ns.cluster.shared_residual import ROOM, SharedResidual
from abcd_ns.engine.events import Event
from abcd_ns.engine.gaussians.adam import Adam
from abcd_ns.engine.gaussians.block_state import BlockState
from abcd_ns.engine.render import Rasterizer
from abcd_ns.engine.render.loss import squared_errors
from abcd_ns.engine.space.tree import Box
from abcd_ns.engine.store.scene import VisitScene
from abcd_ns.engine.store.special_blocks import BlockName
from abcd_ns.engine.train.capture.light import HeldLight
from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.train.planner import Visits
from abcd_ns.engine.train.run import TrainingRun
from abcd_ns.engine.train.run_state import ActiveVisit, Budget, RunState, Stopwatch
from abcd_ns.engine.train.step.batch import Batch, Rendered, Sample, Target
from abcd_ns.engine.train.step.layer_source import LayerRoom
from abcd_ns.engine.train.training_loop import Judgement, take_step
from abcd_ns.engine.train.visit_training import VisitTraining
from abcd_ns.engine.types import Gaussians, View


@dataclass(frozen=True)
class RunSetup:
    """What all visits of a run have in common."""

    config: TrainingConfig
    budget: Budget
    views: list[View]
    optimizers: dict[str, dict[str, Any]]  # by parameter, Adam's options before the first step
    layer_room: LayerRoom  # of each worker

    @staticmethod
    def of(run: TrainingRun, layer_room: LayerRoom) -> "RunSetup":
        """Of a run that begins."""
        groups = {name: optimizer.param_groups[0] for name, optimizer in run.optimizers.items()}
        kept = ("lr", "betas", "eps")
        options = {name: {key: group[key] for key in kept} for name, group in groups.items()}
        return RunSetup(run.config, run.budget, list(run.views.values()), options, layer_room)


class AssignedScene(VisitScene):
    """The blocks of a moment: the assigned one with the state that its visit begins with, the others as they
    are drawn, which `drawn` reads by block. What only an active block has is that of the assigned one."""

    def __init__(self, task: VisitTask, state: BlockState, drawn: Drawn) -> None:
        self.tree, self._task = task.tree, task
        self._block, self._state = task.active.geometry.block, state
        self._drawn = {number: cache(read) for number, read in drawn.items()}
        self._active: Callable[[], Gaussians] | None = None

    def set_active(self, block: int | None, gaussians: Callable[[], Gaussians], sh_degree: int = 0) -> None:  # noqa: ARG002
        self._active = gaussians

    def state(self, name: BlockName) -> BlockState:  # noqa: ARG002
        return self._state

    def pending_for(self, block: int) -> BlockState | None:  # noqa: ARG002 - it has had them
        return None

    def rows(self, name: BlockName) -> int:
        return len(self.state(name))

    def stored_with_pending(self, block: int) -> Gaussians:
        return self.state(block).gaussians

    def gaussians(self, block: int) -> Gaussians:
        if block != self._block:
            return self._drawn[block]()
        return self._state.gaussians if self._active is None else self._active().detach()

    def as_drawn(self) -> Gaussians:
        """The assigned block as others draw it: without Gaussians that join in this visit."""
        return self._drawn[self._block]()

    def count(self, block: int) -> int:
        is_active = block == self._block and self._active is not None
        return len(self._active()) if is_active else self._task.counts[block]

    def bounds(self, block: int) -> Box | None:
        return self._task.bounds[block]


class OnAssignment(Visits):
    """The terms of a visit that somebody else has decided on."""

    def __init__(self, run: TrainingRun, task: VisitTask, begun: int) -> None:
        self._run, self._task, self._begun = run, task, begun

    def begin(self, at_once: int = 1) -> ActiveVisit:  # noqa: ARG002 - there is but one
        return self._run.active

    def room(self) -> int | None:
        """What the block's limit, and its part of the scene's, leave."""
        config, gaussians = self._run.config, len(self._run.params["means"])
        left = 0 if self._task.allowance is None else self._task.allowance - (gaussians - self._begun)
        limit = self._run.limits.of_block(self._task.tree.num_blocks)
        return config.room((config.density.limit or 0) - left, gaussians, limit)


@dataclass(frozen=True)
class VisitWorker:
    """Trains visits on what `target` gives for a sample; `read_ahead` hears of photos wanted soon."""

    setup: RunSetup
    rasterizer: Rasterizer
    target: Callable[[Sample], Target]
    device: torch.device | str = "cpu"
    read_ahead: Callable[[Event], None] = lambda _: None

    def visit(
        self,
        task: VisitTask,
        state: BlockState,
        drawn: Drawn,
        listen: Callable[[Event], None] = lambda _: None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> VisitOutcome:
        """Train a block, which begins with `state`, between the others, of which only those that some picture
        shows are read. `clock` is of training time."""
        scene = AssignedScene(task, state, drawn)
        run = self._run_of(task, scene)
        run.announce.subscribe(listen)
        run.announce.subscribe(self.read_ahead)
        run.stopwatch = Stopwatch(task.seconds, clock)
        run.stopwatch.start()
        pictures, layers = self.setup.layer_room.parted(ROOM if task.beside else 0.0)
        training = VisitTraining(run, OnAssignment(run, task, len(state)), layers)
        training.attach(run.active)
        shared = SharedResidual(run, training, scene.as_drawn, task.beside, pictures)
        while not training.is_over:
            self._take_step(training, shared)
        active, block, result = run.active, run.active.geometry.block, training.finish()
        shown, health = run.state.influence[block], run.state.health[block]
        return VisitOutcome(result, active.done, shown, health, active.layer_seconds)

    def _run_of(self, task: VisitTask, scene: AssignedScene) -> TrainingRun:
        setup, block, device = self.setup, task.active.geometry.block, torch.device(self.device)
        params = {n: Parameter(v) for n, v in Gaussians.empty(setup.config.sh_degree, device).items()}
        adams = {n: Adam([params[n]], fused=True, **options) for n, options in setup.optimizers.items()}
        # Two workers may show one photo: whose transform should stay?
        light = None if setup.config.light == "none" else HeldLight(task.light, device)
        drawn = scene, setup.views, self.rasterizer, params, adams
        run = TrainingRun(setup.config, setup.budget, *drawn, device=device, light=light)
        run.state = RunState(
            step=task.step,
            sh_degree=task.active.sh_degree,
            epoch=task.epoch,
            visit=task.active.number + 1,
            influence={block: {}},
            health={block: copy.copy(task.health)},
            active=copy.deepcopy(task.active),
        )
        run.poses.restore(task.poses)
        return run

    def _take_step(self, training: VisitTraining, shared: SharedResidual) -> None:
        def assess(part: Batch, rendered: Rendered) -> Judgement:
            rows = []
            for sample, picture in zip(part.samples, rendered.pictures, strict=True):
                photo, counts = self.target(sample)
                found = picture, photo, shared.target(sample, photo)
                rows.append(found if counts is None else [each * counts.to(picture.device) for each in found])
            pictures, photos, wanted = map(list, zip(*rows, strict=True))
            return training.loss(part, pictures, wanted), squared_errors(pictures, photos)

        take_step(training, training.run.optimizers, assess)
