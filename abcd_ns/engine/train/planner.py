"""Which block is trained next, on which views, and for how many steps."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from statistics import median_high
from typing import Protocol, runtime_checkable

from torch import Tensor

from abcd_ns.engine.gaussians.param_swap import Params, active_gaussians
from abcd_ns.engine.layers.footprints import VisitGeometry, footprints
from abcd_ns.engine.space.influence import overlaps, visible_blocks, worth_training
from abcd_ns.engine.space.tree import in_float64
from abcd_ns.engine.space.visibility import ROUNDING, Frusta, Optics
from abcd_ns.engine.store.special_blocks import DEFERRED, WHOLE
from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.train.health_record import BlockHealth
from abcd_ns.engine.train.run import TrainingRun
from abcd_ns.engine.train.run_state import UNLIMITED, ActiveVisit, RunState, VisitKind
from abcd_ns.engine.train.schedule import (
    VisitPlan,
    passes_of_visit,
    plan_epoch,
    views_per_step,
    views_per_visit,
    visit_views,
)
from abcd_ns.engine.train.step.batch import Batch
from abcd_ns.engine.types import Gaussians, View
from abcd_ns.errors import UserError

DOUBTED = 8
"""Views that hardly show a block, as far as known, of which a visit looks at the first that sees it."""
MANY, SAMPLE = 100, 64
"""Of a block that more views may see, only so many Gaussians, evenly spaced, are looked for in them."""
LOOK_AGAIN = 4
"""Blocks that were hidden behind others are looked at again every so many epochs."""


class NothingSeenError(UserError, RuntimeError):
    """There is nothing to train: no view sees any Gaussian, or none is left."""


class BlocksBusyError(Exception):
    """All blocks whose turn it is are with workers."""


@runtime_checkable
class Visits(Protocol):
    """Decides which block is trained when, and on what terms."""

    def begin(self, at_once: int = 1) -> ActiveVisit:
        """The next visit, which from now on is the run's active one.

        Args:
            at_once: visits that are out at once, this one included.

        Raises:
            NothingSeenError: no view sees any block.
        """

    def attached(self, active: ActiveVisit, params: Params) -> Callable[[], Gaussians]:  # noqa: ARG002
        """Its block is active, at the visit's beginning or after a resume. What others see of it meanwhile:
        all that is active."""
        return lambda: active_gaussians(params)

    def room(self) -> int | None:
        """Gaussians that may be added to the block; None for any number."""

    def compared(
        self,
        batch: Batch,  # noqa: ARG002 - all alike
        pictures: Sequence[Tensor],
        photos: Sequence[Tensor],
    ) -> tuple[Sequence[Tensor], Sequence[Tensor]]:
        """What the loss compares, pictures and photos as far as they say something about the block: all."""
        return pictures, photos


def typical(views: Mapping[int, int]) -> int:
    """Of the blocks that views see, by how many the median one is seen."""
    return median_high(filter(None, views.values()))


def views_of_step(config: TrainingConfig, blocks: int, trained: int) -> int:
    """Views in a step of a block that was trained on so many, one of several: fewer while it is
    under-trained, where its steps are larger for that."""
    known = trained + config.recipe.trained_before if config.recipe.fast_start else None
    return views_per_step(config.batch, blocks, known)


class Planner(Visits):
    """ABCD's visits: epochs over all blocks that any view sees, after a warm-up; all that it remembers is in
    the run's state."""

    def __init__(self, run: TrainingRun) -> None:
        self._run = run
        self._config, self._budget, self._scene = run.config, run.budget, run.scene
        self._culling: tuple[dict[int, View], Frusta, Frusta, Optics] | None = None

    def begin(self, at_once: int = 1) -> ActiveVisit:
        """The warm-up, or a visit to the next block that some view sees; blocks that none sees any more are
        passed over, and most of the time those that no picture showed when they were last visited.

        Raises:
            BlocksBusyError: the blocks that are left in this epoch are in flight.
        """
        run, state = self._run, self._run.state
        began = run.stopwatch.seconds
        if state.visit == 0 and self._scene.has(DEFERRED) and run.progress < self._config.warmup:
            state.active = self._warm_up(run.sh_degree, began)
        else:
            state.active = self._next_visit(state, run.sh_degree, began, at_once)
        state.visit += 1
        state.sh_degree = max(state.sh_degree, state.active.sh_degree)
        return state.active

    def room(self) -> int | None:
        """What the limits of scene and block leave; in the warm-up what the memory of a visit holds."""
        run, gaussians = self._run, len(self._run.params["means"])
        if run.active.is_whole:
            deferred, limit = self._scene.rows(DEFERRED), self._config.density.limit
            most = self._config.limits.coarse_gaussians
            return (most if limit is None else min(most, limit - deferred)) - gaussians
        return self._config.room(run.count(), gaussians, run.limits.of_block(run.blocks))

    def _warm_up(self, sh_degree: int, began: float) -> ActiveVisit:
        """The visit in which the coarse model of all blocks is trained."""
        crops = {index: view.full for index, view in self._run.views.items()}
        geometry = VisitGeometry(WHOLE, crops)
        return ActiveVisit(0, VisitKind.COARSE, geometry, sh_degree, UNLIMITED, geometry.views, began=began)

    def _next_visit(self, state: RunState, sh_degree: int, began: float, at_once: int) -> ActiveVisit:
        while True:
            plan = self._next_plan(state, at_once)
            views = self._may_see(plan.block)
            # Where nothing is known, or what shows the block has changed, all views are asked.
            for ask in (partial(self._known_to_show, state), self._sampled, self._seeing):
                active = self._visit(state, plan, views, ask(plan.block, views), sh_degree)
                if active is not None:
                    active.began = began
                    return active

    def _visit(
        self,
        state: RunState,
        plan: VisitPlan,
        views: Mapping[int, View],
        showing: tuple[int, ...],
        sh_degree: int,
    ) -> ActiveVisit | None:
        """The next visit to a block; None if those of its views whose turn it is do not see it after all.

        Args:
            views: that may see the block.
            showing: those of them that are worth training it on.
        """
        block, seed = plan.block, self._config.seed
        state.views[block] = len(showing)
        if not showing:
            return None
        if self._scene.tree.num_blocks == 1:
            return self._sole_visit(state, block, showing, sh_degree)
        used, earlier = self._views_used(state, len(showing)), state.health.get(block, BlockHealth()).visits
        doubtful = tuple(sorted(views.keys() - set(showing)))
        chosen = visit_views(showing, used, earlier, seed)
        doubted = visit_views(doubtful, DOUBTED, earlier, seed) if doubtful else ()
        # Of thousands of views, only those that it uses are asked where they see the block.
        asked = {view: views[view] for view in (*chosen, *doubted)}
        share = self._config.recipe.influence_share
        found = self._footprints(block, asked, share)
        chosen, doubted = (tuple(v for v in some if v in found.crops) for some in (chosen, doubted))
        if not chosen:
            return None
        looked_at = doubted[:1]
        geometry = VisitGeometry(block, {view: found.crops[view] for view in (*chosen, *looked_at)})
        known = state.influence if share < 1 else {}
        visible = visible_blocks(known, geometry.views, self._scene.tree.num_blocks)
        return ActiveVisit(
            number=state.visit,
            kind=VisitKind.BLOCK,
            geometry=geometry,
            sh_degree=self._config.sh_degree if self._config.recipe.sh_restart else sh_degree,
            steps=plan.steps,
            views=(*chosen, *looked_at),
            visible=visible,
            batch=plan.batch,
            looked_at=looked_at,
            showing=showing,
        )

    def _sole_visit(
        self, state: RunState, block: int, showing: tuple[int, ...], sh_degree: int
    ) -> ActiveVisit:
        """The visit to a block that is the whole scene: all that is left of the run, on whole views, for the
        block may grow anywhere."""
        steps = UNLIMITED if self._budget.steps is None else self._budget.steps - state.step
        geometry = VisitGeometry(block, {view: self._run.views[view].full for view in showing})
        return ActiveVisit(state.visit, VisitKind.JOINT, geometry, sh_degree, steps, geometry.views)

    def _known_to_show(self, state: RunState, block: int, views: Iterable[int]) -> tuple[int, ...]:
        """Of the views that may see the block, those that show nearly all that is to be seen of it, as far as
        that is known; empty if it is not."""
        known = state.influence.get(block)
        if known is None or self._config.recipe.influence_share >= 1:
            return ()
        seen = {view: known[view] for view in views if view in known}
        return worth_training(seen, self._config.recipe.influence_share)

    def _next_plan(self, state: RunState, at_once: int) -> VisitPlan:
        while not state.queue:
            self._plan_epoch(state, at_once)
        busy = sorted({visit.geometry.block for visit in state.in_flight})
        free = [place for place, plan in enumerate(state.queue) if plan.block not in busy]
        if not free:
            raise BlocksBusyError
        beside = overlaps(state.influence, (state.queue[place].block for place in free), busy)
        return state.queue.pop(free[beside.index(min(beside))])

    def _plan_epoch(self, state: RunState, at_once: int) -> None:
        """Queue the visits of the next epoch; none where all that are seen are hidden behind others."""
        config = self._config
        if not state.views:
            state.views = self._views_of_blocks(state)
        else:
            state.epoch += 1
            self._look_at_arrivals(state)
        if not any(state.views.values()):
            raise NothingSeenError("no training view sees any Gaussian: check the poses and the points")
        remaining = None if self._budget.steps is None else self._budget.steps - state.planned
        used = {block: self._views_used(state, seen) for block, seen in state.views.items()}
        blocks = self._scene.tree.num_blocks
        passes = passes_of_visit(config.recipe.passes, typical(used), at_once, blocks)
        if state.epoch % LOOK_AGAIN:
            hidden = {block for block, record in state.health.items() if record.hidden}
            used = {block: views for block, views in used.items() if block not in hidden}
        steps = (passes, remaining, config.seed, config.recipe.visit_steps)
        clocks = self._scene.clocks
        batches = {block: views_of_step(config, blocks, clocks(block).adam_views) for block in used}
        state.queue = list(plan_epoch(state.epoch, used, *steps, batches))

    def _look_at_arrivals(self, state: RunState) -> None:
        """A block that no view saw may be seen once others have come into it."""
        for block, seen in state.views.items():
            if not seen and self._scene.pending_for(block) is not None:
                state.views[block] = self._views_that_see(block)

    def _views_of_blocks(self, state: RunState) -> dict[int, int]:
        """As far as influences are known they tell; a visit looks again."""
        views = {}
        for block in range(self._scene.tree.num_blocks):
            known = self._known_to_show(state, block, state.influence.get(block, ()))
            views[block] = len(known) or self._views_that_see(block)
        return views

    def _views_that_see(self, block: int) -> int:
        views = self._may_see(block)
        return len(self._sampled(block, views) or self._seeing(block, views))

    def _seeing(self, block: int, views: Mapping[int, View]) -> tuple[int, ...]:
        """Those of the views that see the block."""
        return self._footprints(block, views).views

    def _sampled(self, block: int, views: Mapping[int, View]) -> tuple[int, ...]:
        """Of MANY views, those in which a mean of the block's lies, as far as SAMPLE tell; of fewer, none."""
        if len(views) <= MANY:
            return ()
        means = self._scene.stored_with_pending(block).means
        found, _, inner, _ = self._culling
        rows = [row for row, view in enumerate(found) if view in views]
        points = in_float64(means[:: -(-len(means) // SAMPLE)]).cpu()
        holds = inner.may_show(points[:, None].expand(-1, 2, -1), rows).any(dim=0).tolist()
        return tuple(view for view, held in zip(views, holds, strict=True) if held)

    def _views_used(self, state: RunState, seen: int) -> int:
        """Of the views that see a block, how many a visit uses."""
        limit = self._config.recipe.visit_views
        return views_per_visit(seen, typical(state.views), limit) if seen else 0

    def _may_see(self, block: int) -> dict[int, View]:
        """The views whose frusta meet the block's bounds, by index."""
        bounds = self._scene.bounds(block)
        if bounds is None:
            return {}
        found = self._run.views
        if self._culling is None or self._culling[0] is not found:  # poses moved
            views, slack = list(found.values()), self._run.rasterizer.slack
            outer, inner = (Frusta(((v, v.full) for v in views), by) for by in (slack, -ROUNDING - 1))
            self._culling = found, outer, inner, Optics(views, slack)
        _, frusta, _, optics = self._culling
        (shows,) = frusta.may_show(optics.drawn_within([bounds])).tolist()
        return {index: view for (index, view), may in zip(found.items(), shows, strict=True) if may}

    def _footprints(self, block: int, views: Mapping[int, View], share: float = 1.0) -> VisitGeometry:
        if not views:
            return VisitGeometry(block, {})
        gaussians = self._scene.stored_with_pending(block).to(self._run.device)
        return footprints(gaussians, block, views.values(), self._run.rasterizer, share)
