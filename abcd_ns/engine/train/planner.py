"""Which block is trained next, on which views, and for how many steps."""

import math
from collections.abc import Mapping

import torch

from abcd_ns.engine.layers.visit_layers import VisitGeometry, survey
from abcd_ns.engine.render import Rasterizer
from abcd_ns.engine.space.culling import Frusta, Optics
from abcd_ns.engine.space.influence import worth_training
from abcd_ns.engine.store.scene import StoredScene
from abcd_ns.engine.store.special_blocks import WHOLE
from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.train.run_state import UNLIMITED, ActiveVisit, Budget, RunState
from abcd_ns.engine.train.schedule import (
    SCAFFOLD_PASSES,
    VisitPlan,
    passes_for_layers,
    passes_of_sweep,
    plan_sweep,
    views_per_step,
    views_per_visit,
    views_per_warm_up_step,
    visit_views,
)
from abcd_ns.engine.types import View
from abcd_ns.errors import UserError

LOOK_AGAIN = 4
"""Blocks that were hidden behind others are looked at again every so many sweeps."""


class NothingSeenError(UserError, RuntimeError):
    """There is nothing to train: no view sees any Gaussian, or none is left."""


class Planner:
    """Plans the visits of a run; all that it remembers is in the run's state.

    Args:
        views: the training views, by index.
    """

    def __init__(
        self,
        config: TrainingConfig,
        budget: Budget,
        scene: StoredScene,
        views: Mapping[int, View],
        rasterizer: Rasterizer,
        *,
        device: torch.device,
    ) -> None:
        self._config, self._budget, self._scene = config, budget, scene
        self._views, self._rasterizer, self._device = views, rasterizer, device
        side = rasterizer.window_side
        self._frusta = Frusta(((view, view.full) for view in views.values()), side)
        self._optics = Optics(list(views.values()), side)

    def warm_up(self, sh_degree: int, began: float) -> ActiveVisit:
        """The visit in which the scaffold of all blocks is trained."""
        crops = {index: view.full for index, view in self._views.items()}
        geometry, steps = VisitGeometry(WHOLE, crops), self._budget.steps
        taken = UNLIMITED if steps is None else math.ceil(steps * self._config.warmup)
        views = views_per_warm_up_step(self._config.batch, self._config.limits.batch_limit)
        taken = min(taken, math.ceil(SCAFFOLD_PASSES * len(crops) / views))
        return ActiveVisit(0, geometry, sh_degree, taken, geometry.views, began=began)

    def next_visit(self, state: RunState, sh_degree: int, began: float) -> ActiveVisit:
        """A visit to the next block that some view sees; blocks that none sees any more are passed over, and
        most of the time those that no picture showed when they were last visited.

        Raises:
            NothingSeenError: no view sees any block.
        """
        while True:
            plan = self._next_plan(state)
            if self._is_hidden(state, plan.block) and state.sweep % LOOK_AGAIN:
                continue
            geometry = self._survey(plan.block)
            kept = self._worth_training(state, geometry)
            state.views[plan.block] = len(kept)
            if kept and self._scene.tree.num_blocks == 1:
                return self._sole_visit(state, plan.block, kept, sh_degree, began)
            if kept:
                return self._visit(state, plan, geometry, kept, sh_degree, began)

    @staticmethod
    def _is_hidden(state: RunState, block: int) -> bool:
        return block in state.health and state.health[block].hidden

    def _visit(
        self,
        state: RunState,
        plan: VisitPlan,
        geometry: VisitGeometry,
        kept: tuple[int, ...],
        sh_degree: int,
        began: float,
    ) -> ActiveVisit:
        seed, used = self._config.seed, self._views_used(state, len(kept))
        earlier = self._scene.clocks(plan.block).visits
        doubtful = tuple(view for view in geometry.views if view not in set(kept))
        looked_at = visit_views(doubtful, 1, earlier, seed) if doubtful else ()
        return ActiveVisit(
            number=state.visit,
            geometry=geometry,
            sh_degree=self._config.sh_degree if self._config.recipe.sh_restart else sh_degree,
            steps=plan.steps,
            views=(*visit_views(kept, used, earlier, seed), *looked_at),
            looked_at=looked_at,
            began=began,
        )

    def _sole_visit(
        self, state: RunState, block: int, kept: tuple[int, ...], sh_degree: int, began: float
    ) -> ActiveVisit:
        """The visit to a block that is the whole scene: all that is left of the run, on whole views, for the
        block may grow anywhere."""
        steps = UNLIMITED if self._budget.steps is None else self._budget.steps - state.step
        geometry = VisitGeometry(block, {view: self._views[view].full for view in kept})
        return ActiveVisit(state.visit, geometry, sh_degree, steps, geometry.views, began=began, sole=True)

    def _worth_training(self, state: RunState, geometry: VisitGeometry) -> tuple[int, ...]:
        """Of the views that see the block, those that show nearly all that is to be seen of it."""
        known = state.influence.get(geometry.block)
        if known is None or self._config.influence_share >= 1:
            return geometry.views
        seen = {view: known[view] for view in geometry.views if view in known}
        # What a block has got since, Gaussians from the reserve say, may be seen where it was not before.
        return worth_training(seen, self._config.influence_share) or geometry.views

    def _next_plan(self, state: RunState) -> VisitPlan:
        config = self._config
        if not state.queue:
            if not state.views:
                state.views = self._views_of_blocks(state)
            else:
                state.sweep += 1
            remaining = None if self._budget.steps is None else self._budget.steps - state.step
            last = config.last_passes or passes_for_layers(state.trained, state.frozen)
            state.trained = state.frozen = 0
            passes = passes_of_sweep(state.sweep, config.first_passes, last)
            used = {block: self._views_used(state, seen) for block, seen in state.views.items()}
            batch = views_per_step(config.batch, self._scene.tree.num_blocks, config.limits.batch_limit)
            steps = (passes / batch, remaining, config.seed, config.recipe.visit_steps)
            state.queue = list(plan_sweep(state.sweep, used, *steps))
            if not state.queue:
                raise NothingSeenError("no training view sees any Gaussian: check the poses and the points")
        return state.queue.pop(0)

    def _views_of_blocks(self, state: RunState) -> dict[int, int]:
        """As far as influences are known they tell; a visit looks again."""
        views, share = {}, self._config.influence_share
        for block in range(self._scene.tree.num_blocks):
            known = state.influence.get(block) if share < 1 else None
            views[block] = len(worth_training(known, share) if known else self._survey(block).views)
        return views

    def _views_used(self, state: RunState, seen: int) -> int:
        """Of the views that see a block, how many a visit uses."""
        most = max(state.views.values())
        return views_per_visit(seen, most, self._config.visit_views) if most else 0

    def _survey(self, block: int) -> VisitGeometry:
        bounds = self._scene.bounds(block)
        if bounds is None:
            return VisitGeometry(block, {})
        (shows,) = self._frusta.may_show([self._optics.drawn_within(bounds)]).tolist()
        near = [view for view, may in zip(self._views.values(), shows, strict=True) if may]
        return survey(self._scene.at_rest(block).to(self._device), block, near, self._rasterizer)
