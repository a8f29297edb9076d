"""Which block is trained next, on which views, and for how many steps."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from statistics import median_high

from abcd_ns.engine.events import CutAnew
from abcd_ns.engine.gaussians.param_swap import Params, active_gaussians
from abcd_ns.engine.layers.footprints import VisitGeometry, footprints
from abcd_ns.engine.space.influence import overlaps, visible_blocks, worth_training
from abcd_ns.engine.space.visibility import Frusta, Optics
from abcd_ns.engine.store.commit import pending_without, with_pending
from abcd_ns.engine.store.scene import MemoryScene
from abcd_ns.engine.store.special_blocks import DEFERRED, WHOLE
from abcd_ns.engine.train import schedule
from abcd_ns.engine.train.density.splitting import cut_anew
from abcd_ns.engine.train.memory import limits_at, parameter_bytes
from abcd_ns.engine.train.run import TrainingRun
from abcd_ns.engine.train.run_state import UNLIMITED, ActiveVisit, BlockHealth, VisitKind
from abcd_ns.engine.train.step.batch import Batch, Pictures
from abcd_ns.engine.train.step.layer_source import influence_by_layers
from abcd_ns.engine.types import Gaussians, View
from abcd_ns.errors import UserError

DOUBTED = 8
"""Views that hardly show a block, as far as known, of which a visit looks at the first that sees it."""
MANY = 100
"""Of more views than that, only those that a visit uses are asked whether they see the block."""
REFILLED = 0.85
"""Share of its limit to which a block is filled anew: below FULL, so that a few migrants do not cut it."""
LOOK_AGAIN = 4
"""Blocks that were hidden behind others are looked at again every so many epochs."""


class NothingSeenError(UserError, RuntimeError):
    """There is nothing to train: no view sees any Gaussian, or none is left."""


class BlocksBusyError(Exception):
    """All blocks whose turn it is are with workers."""


class Visits(ABC):
    """Decides which block is trained when, and on what terms."""

    @abstractmethod
    def begin(self, at_once: int = 1) -> ActiveVisit:
        """The next visit, of `at_once`, now the active one; a NothingSeenError if no view sees any block."""

    def attached(self, active: ActiveVisit, params: Params) -> Callable[[], Gaussians]:  # noqa: ARG002
        """Call when the visit's block has become active. Gives what others see of it meanwhile: all of it."""
        return lambda: active_gaussians(params)

    @abstractmethod
    def room(self) -> int | None:
        """Gaussians that may be added to the block; None for any number."""

    def compared(self, batch: Batch, pictures: Pictures, photos: Pictures) -> tuple[Pictures, Pictures]:  # noqa: ARG002
        """What the loss compares, pictures and photos as far as they say something about the block: all."""
        return pictures, photos


class Planner(Visits):
    """ABCD's visits: after a warm-up, epochs over all blocks that any view sees."""

    def __init__(self, run: TrainingRun) -> None:
        self._run, self._config, self._scene = run, run.config, run.scene
        self._culling: tuple[dict[int, View], Frusta, Optics] | None = None
        self._since, self._taken = math.inf, 0

    def begin(self, at_once: int = 1) -> ActiveVisit:
        """The warm-up, or a visit to the next block that some view sees; most epochs pass over blocks that no
        picture showed last time. A BlocksBusyError if all that are left in this epoch are in flight."""
        run, state = self._run, self._run.state
        began = run.stopwatch.seconds
        if run.warm_up_is_next:
            whole = VisitGeometry(WHOLE, {index: view.full for index, view in run.views.items()})
            state.active = ActiveVisit(0, VisitKind.COARSE, whole, run.sh_degree, UNLIMITED, whole.views)
        else:
            state.active = self._next_visit(at_once)
        state.active.began = began
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

    def _next_visit(self, at_once: int) -> ActiveVisit:
        while True:
            plan = self._next_plan(at_once)
            views = self._may_see(plan.block)
            if self._scene.tree.num_blocks == 1:
                return self._sole_visit(plan.block, views)
            # Where nothing is known, or what shows the block has changed, all views are asked.
            for ask in (self._known_to_show, self._many, self._seeing):
                if (active := self._visit(plan, views, ask(plan.block, views))) is not None:
                    return active

    def _visit(
        self, plan: schedule.VisitPlan, views: Mapping[int, View], showing: tuple[int, ...]
    ) -> ActiveVisit | None:
        """The next visit to a block, on some of the views that show it; None if those whose turn it is do not
        see it after all."""
        state, block, seed = self._run.state, plan.block, self._config.seed
        state.views[block] = len(showing)
        if not showing:
            return None
        used, earlier = self._views_used(len(showing)), state.health.get(block, BlockHealth()).visits
        # Where no influence is on record, none is compared with it.
        doubtful = tuple(sorted(views.keys() - set(showing))) if block in state.influence else ()
        chosen = schedule.visit_views(showing, used, earlier, seed)
        doubted = schedule.visit_views(doubtful, DOUBTED, earlier, seed) if doubtful else ()
        # Of thousands of views, only those that it uses are asked where they see the block.
        asked = {view: views[view] for view in (*chosen, *doubted)}
        share = self._config.recipe.influence_share
        crops = self._footprints(block, asked, share).crops
        chosen = tuple(view for view in chosen if view in crops)
        looked_at = tuple(view for view in doubted if view in crops)[:1]
        if not chosen:
            return None
        used_views = (*chosen, *looked_at)
        geometry = VisitGeometry(block, {view: crops[view] for view in used_views})
        known = state.influence if share < 1 else {}
        return ActiveVisit(
            number=state.visit,
            kind=VisitKind.BLOCK,
            geometry=geometry,
            sh_degree=self._config.sh_degree if self._config.recipe.sh_restart else self._run.sh_degree,
            steps=plan.steps,
            views=used_views,
            visible=visible_blocks(known, geometry.views, self._scene.tree.num_blocks),
            batch=plan.batch,
            looked_at=looked_at,
            showing=showing,
        )

    def _sole_visit(self, block: int, views: Mapping[int, View]) -> ActiveVisit:
        """The visit to a block that is the whole scene: for the rest of the run, on whole views, also on
        those that see next to nothing of it."""
        run, total = self._run, self._run.budget.steps
        steps = UNLIMITED if total is None else total - run.state.step
        run.state.views[block] = len(views)
        geometry = VisitGeometry(block, {index: view.full for index, view in views.items()})
        return ActiveVisit(run.state.visit, VisitKind.JOINT, geometry, run.sh_degree, steps, geometry.views)

    def _next_plan(self, at_once: int) -> schedule.VisitPlan:
        state = self._run.state
        while not state.queue:
            self._plan_epoch(at_once)
        busy = sorted({visit.geometry.block for visit in state.in_flight})
        free = [place for place, plan in enumerate(state.queue) if plan.block not in busy]
        if not free:
            raise BlocksBusyError
        beside = overlaps(state.influence, (state.queue[place].block for place in free), busy)
        place = free[beside.index(min(beside))]
        if self._cut(state.queue[place].block):
            return self._next_plan(at_once)
        steps = self._steps_of(state.queue[place])
        plan = state.queue.pop(place)._replace(steps=steps)
        self._since = min(self._since, self._run.stopwatch.seconds)
        self._taken += _views_of(plan)
        return plan

    def _cut(self, block: int) -> bool:
        """Cut a block that is too large for a visit by now, as it gets more harmonics; whether it was. Its
        parts take its place in the queue."""
        run, scene = self._run, self._scene
        if not run.limits.is_full(scene.count(block), scene.tree.num_blocks):
            return False
        tree, parts = run.cut({block: with_pending(scene, block), **pending_without(scene, block)})
        if tree is scene.tree:  # all of it coincides
            return False
        run.persist(tree, parts, self._config.commit_seconds)
        return True

    def _steps_of(self, plan: schedule.VisitPlan) -> int:
        """Of a visit in the queue: as many as planned, or, in the last epoch, its share of what is left. An
        epoch is the last where the budget leaves less than half of one after it."""
        share, waiting = self._share_left(), sum(map(_views_of, self._run.state.queue))
        if share * waiting >= waiting + self._run.state.of_epoch / 2:
            return plan.steps
        return max(round(plan.steps * min(share, 2)), 1)

    def _share_left(self) -> float:
        """How often the budget suffices for the visits in the queue; infinite where nothing tells."""
        budget, state, now = self._run.budget, self._run.state, self._run.stopwatch.seconds
        shares = [math.inf]
        if budget.steps is not None:
            shares.append((budget.steps - state.planned) / sum(plan.steps for plan in state.queue))
        if budget.seconds is not None and now > self._since:  # at the pace since this process began
            left = max(budget.seconds - now, 0.0) * self._taken / (now - self._since)
            shares.append(left / sum(map(_views_of, state.queue)))
        return min(shares)

    def _cut_anew(self, at_once: int) -> None:
        """Once growth has ended, cut the scene into fewer blocks where pruning has left room, if RAM holds
        it; two at least for each visit `at_once`. A BlocksBusyError while a block is in flight."""
        run, config = self._run, self._config
        limit, count = limits_at(config, config.sh_degree).block_limit, run.count()
        if run.share < config.density.refine_stop or not config.recipe.migrate or not limit:
            return
        blocks = max(math.ceil(count / max(REFILLED * limit, 1.0)), 2 * at_once)
        of_each = 3 * parameter_bytes(config.sh_degree)  # with moments
        if blocks >= run.blocks or 2 * of_each * count > self._scene.ram_bytes:
            return
        if run.state.in_flight:
            raise BlocksBusyError
        tree, updates = cut_anew(self._scene, blocks)
        scene = MemoryScene(tree, Gaussians.cat([updates[block].gaussians for block in range(blocks)]))
        run.state.renumber(blocks, influence_by_layers(run, scene))
        run.persist(tree, updates, config.commit_seconds)
        run.announce(CutAnew(blocks))

    def _plan_epoch(self, at_once: int) -> None:
        """Queue the visits of the next epoch; none where all that are seen are hidden behind others."""
        if self._run.state.views:
            self._cut_anew(at_once)
        recipe, state, blocks = self._config.recipe, self._run.state, self._scene.tree.num_blocks
        if not state.views:
            views = {}
            for block in range(blocks):  # a visit looks again
                known = self._known_to_show(block, state.influence.get(block, ()))
                views[block] = len(known) or self._views_seeing(block)
            state.views = views  # all or none, as looking may fail
        else:
            state.epoch += 1
            for block, seen in state.views.items():
                # Others may have come into a block that no view saw.
                if not seen and self._scene.pending_for(block) is not None:
                    state.views[block] = self._views_seeing(block)
        if not any(state.views.values()):
            raise NothingSeenError("no training view sees any Gaussian: check the poses and the points")
        used = {block: self._views_used(seen) for block, seen in state.views.items()}
        passes = schedule.passes_of_visit(recipe.passes, _typical(used), at_once, blocks)
        if state.epoch % LOOK_AGAIN:
            hidden = {block for block, record in state.health.items() if record.hidden}
            used = {block: views for block, views in used.items() if block not in hidden}
        batches = {block: self._views_of_step(block) for block in used}
        options = passes, self._config.seed, recipe.visit_steps, batches
        state.queue = list(schedule.plan_epoch(state.epoch, used, *options))
        state.of_epoch = sum(map(_views_of, state.queue))

    def _views_of_step(self, block: int) -> int:
        """Fewer while the block is under-trained, where its steps are larger for that."""
        config, trained = self._config, None
        if config.recipe.fast_start:
            trained = self._scene.clocks(block).adam_views + config.recipe.trained_before
        return schedule.views_per_step(config.batch, self._scene.tree.num_blocks, trained)

    def _views_used(self, seen: int) -> int:
        """Of the views that see a block, how many a visit uses."""
        limit = self._config.recipe.visit_views
        return schedule.views_per_visit(seen, _typical(self._run.state.views), limit) if seen else 0

    def _views_seeing(self, block: int) -> int:
        views = self._may_see(block)
        return len(self._many(block, views) or self._seeing(block, views))

    def _known_to_show(self, block: int, views: Iterable[int]) -> tuple[int, ...]:
        """The fewest of these views that show nearly all of the block; empty if that is not known."""
        known, share = self._run.state.influence.get(block), self._config.recipe.influence_share
        if known is None or share >= 1:
            return ()
        return worth_training({view: known[view] for view in views if view in known}, share)

    def _many(self, block: int, views: Mapping[int, View]) -> tuple[int, ...]:  # noqa: ARG002
        """All that may see the block if they are MANY: a visit asks those whose turn it is."""
        return tuple(views) if len(views) > MANY else ()

    def _seeing(self, block: int, views: Mapping[int, View]) -> tuple[int, ...]:
        return self._footprints(block, views).views

    def _may_see(self, block: int) -> dict[int, View]:
        """The views whose frusta meet the block's bounds, by index."""
        bounds = self._scene.bounds(block)
        if bounds is None:
            return {}
        found = self._run.views
        if self._culling is None or self._culling[0] is not found:  # poses moved
            views, slack = list(found.values()), self._run.rasterizer.slack
            self._culling = found, Frusta(((v, v.full) for v in views), slack), Optics(views, slack)
        _, frusta, optics = self._culling
        (shows,) = frusta.may_show(optics.drawn_within([bounds])).tolist()
        return {index: view for (index, view), may in zip(found.items(), shows, strict=True) if may}

    def _footprints(self, block: int, views: Mapping[int, View], share: float = 1.0) -> VisitGeometry:
        if not views:
            return VisitGeometry(block, {})
        gaussians = self._scene.stored_with_pending(block).to(self._run.device)
        return footprints(gaussians, block, views.values(), self._run.rasterizer, share)


def _views_of(plan: schedule.VisitPlan) -> int:
    return plan.steps * (plan.batch or 1)


def _typical(views: Mapping[int, int]) -> int:
    """Of the blocks that views see, by how many the median one is seen."""
    return median_high(filter(None, views.values()))
