"""What all parts of a training share: options, the stored scene, active parameters, where the run stands."""

from collections.abc import Iterable
from statistics import median

import torch

from abcd_ns.engine.events import Announcer, BlockSplit
from abcd_ns.engine.gaussians.block_state import BlockState
from abcd_ns.engine.gaussians.param_swap import Optimizers, Params
from abcd_ns.engine.render import Rasterizer
from abcd_ns.engine.space.tree import BlockTree
from abcd_ns.engine.store.scene import VisitScene
from abcd_ns.engine.store.special_blocks import DEFERRED, BlockName
from abcd_ns.engine.train.capture.light import HeldLight, Light
from abcd_ns.engine.train.capture.poses import Poses
from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.train.density.control import DensityControl
from abcd_ns.engine.train.density.splitting import cut_full
from abcd_ns.engine.train.health import Health
from abcd_ns.engine.train.memory import degree_with_room, limits_at
from abcd_ns.engine.train.recipe import Limits
from abcd_ns.engine.train.run_state import ActiveVisit, Budget, RunState, Stopwatch
from abcd_ns.engine.train.schedule import reduction_at, sh_degree_at
from abcd_ns.engine.types import View


class TrainingRun:
    """One training run over a scene, through the caller's parameters and optimizers.

    Args:
        params, optimizers: as `param_swap` wants them. Only their learning rates are used, to decay from.
        light: each photo's; None for what the options ask for, not found yet.
    """

    def __init__(
        self,
        config: TrainingConfig,
        budget: Budget,
        scene: VisitScene,
        views: list[View],
        rasterizer: Rasterizer,
        params: Params,
        optimizers: Optimizers,
        *,
        device: torch.device | str = "cpu",
        light: Light | HeldLight | None = None,
    ) -> None:
        self.config, self.budget, self.scene = config, budget, scene
        self.params, self.optimizers = params, optimizers
        self.poses = Poses(views)
        self._reduced = {1: self.views}
        self._shortest = min((min(view.width, view.height) for view in views), default=0)
        self.rasterizer = rasterizer
        self.device = torch.device(device)
        self.announce = Announcer()
        self.stopwatch = Stopwatch()
        self.state = RunState()
        self.light = light
        if light is None and config.light != "none":
            self.light = Light(config.light, list(self.views), self.device)
        may_act = config.recipe.limit_scales and config.recipe.layers
        self.health = Health(scene, params, optimizers, self.announce, may_act=may_act)
        self.density = DensityControl(config.density.for_views(len(views)), rasterizer.primitive)

    @property
    def views(self) -> dict[int, View]:
        """The training views by index, as they stand by now; on the CPU, whatever the device."""
        return self.poses.views

    def views_at(self, reduction: int) -> dict[int, View]:
        """The same, their pictures reduced."""
        if self._reduced[1] is not self.views:
            self._reduced = {1: self.views}
        if reduction not in self._reduced:
            self._reduced[reduction] = {i: view.reduced(reduction) for i, view in self.views.items()}
        return self._reduced[reduction]

    def reach(self, views: Iterable[int]) -> float:
        """What the means' rate is multiplied by for a block that these views are trained on, world units."""
        return median(self.views[view].reach for view in views)

    @property
    def reduction(self) -> int:
        """By how much pictures are reduced: only where all of the scene is in training."""
        active = self.state.active
        if active is not None and not active.is_all:
            return 1
        return reduction_at(self.progress, self.config.coarse, self._shortest)

    @property
    def blocks(self) -> int:
        """That the scene is trained by: one in the warm-up, which trains all at once."""
        active = self.state.active
        return 1 if active is not None and active.is_whole else self.scene.tree.num_blocks

    @property
    def warm_up_is_next(self) -> bool:
        """Whether the run has yet to train its coarse model."""
        begins = self.state.visit == 0 and self.scene.has(DEFERRED)
        return begins and self.progress < self.config.warmup

    @property
    def progress(self) -> float:
        """Share of the run that is done, 0..1; what workers are at counts as done."""
        return self.budget.progress(self.state.planned, self.stopwatch.seconds)

    @property
    def share(self) -> float:
        """Share that is done, 0..1, of what schedules run over: the run, or a visit's own part of it."""
        active = self.state.active
        return self.progress if active is None else active.share(self.progress)

    @property
    def sh_degree(self) -> int:
        active = self.state.active
        restarts = self.config.recipe.sh_restart and active is not None and not active.is_joint
        share = active.done / active.steps if restarts else self.share
        return min(sh_degree_at(share, self.config.recipe.sh_ramp, self.config.sh_degree), self._degree_limit)

    @property
    def _degree_limit(self) -> int:
        """What limits leave for the degree; it never falls."""
        config, found = self.config, self.config.growing_degree
        grown = self.share >= config.density.refine_stop
        if not config.limits.late_harmonics or (grown and self.among_others):
            return config.sh_degree  # when its visit begins, a block is cut to have room for all
        if grown and self.blocks == 1:
            alone = self.count() if self.state.active is None else len(self.params["means"])
            found = degree_with_room(config, alone)
        return max(self.state.sh_degree, found)

    @property
    def among_others(self) -> bool:
        """Whether blocks are trained between layers of others, or as if they were."""
        return self.blocks > 1 and self.config.recipe.overlap == 0

    @property
    def limits(self) -> Limits:
        """What a block may have at the present degree of harmonics."""
        return limits_at(self.config, self.sh_degree)

    @property
    def active(self) -> ActiveVisit:
        """The visit that is under way; a RuntimeError if none is."""
        if self.state.active is None:
            raise RuntimeError("no visit is under way: call next_batch first")
        return self.state.active

    def count(self) -> int:
        """Gaussians in the whole scene, the active block included."""
        return sum(self.scene.count(block) for block in range(self.scene.tree.num_blocks))

    def cut(self, updates: dict[BlockName, BlockState]) -> tuple[BlockTree, dict[BlockName, BlockState]]:
        """Cut blocks that have outgrown their limit, before they are persisted, and tell listeners. Gives the
        tree and everything to persist."""
        tree, parts, parents = cut_full(self.scene, updates, self.state, self.limits)
        for new, parent in parents.items():
            self.announce(BlockSplit(parent, new))
        return tree, parts

    def persist(self, tree: BlockTree, updates: dict[BlockName, BlockState], within: float) -> None:
        """Persist blocks and the run's state, as one snapshot; on disk within so many seconds."""
        self.state.seconds = self.stopwatch.seconds
        self.state.poses = self.poses.packed()
        tables = self.light.changed() if self.light is not None else {}
        self.scene.persist(tree, {**updates, **tables}, self.state.to_json(), within)

    def restore(self) -> None:
        """Stand where the store's newest generation stands."""
        self.state = RunState.from_json(self.scene.store.state)
        self.stopwatch = Stopwatch(self.state.seconds)
        if self.light is not None:
            self.light.restore(self.scene.table)
        self.poses.restore(self.state.poses)
