"""Block coordinate descent: visits blocks one after the other and trains each within its surroundings.

The coordinator is made of what gives it blocks (`Visits`), layers (`LayerSource`) and gradients
(`StepDrawing`). What is not live lies at rest in the store; listeners are told what happens.
"""

from collections.abc import Callable, Sequence

from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.events import StepTaken, SweepEnded, VisitBegan, VisitEnded
from abcd_ns.engine.gaussians.block_state import BlockState
from abcd_ns.engine.gaussians.param_swap import Pace, live_gaussians
from abcd_ns.engine.space.influence import influence
from abcd_ns.engine.store import crash_points
from abcd_ns.engine.store.settle import settle
from abcd_ns.engine.store.special_blocks import LIVE
from abcd_ns.engine.train.layer_source import LayerSource
from abcd_ns.engine.train.planner import Planner, Visits
from abcd_ns.engine.train.run import TrainingRun
from abcd_ns.engine.train.run_state import ActiveVisit
from abcd_ns.engine.train.schedule import exponential_decay
from abcd_ns.engine.train.splitting import cut_full
from abcd_ns.engine.train.step.batch import Batch, Rendered, Sample
from abcd_ns.engine.train.step.drawing import StepDrawing
from abcd_ns.engine.train.step.live_block import LiveBlock
from abcd_ns.engine.train.step.workers.share import Target
from abcd_ns.engine.train.trainer import Trainer


class Coordinator(Trainer):
    """Trains one block after the other.

    Args:
        visits: decides which; None for ABCD's own.
        source: gives visits their layers; None for the run's scene, and little room.
        target: gives what a sample is trained on, so that helpers can share a step; None for one process.
        live: the block in training; None for one that nobody else looks after.
    """

    def __init__(
        self,
        run: TrainingRun,
        visits: Visits | None = None,
        source: LayerSource | None = None,
        target: Callable[[Sample], Target] | None = None,
        live: LiveBlock | None = None,
    ) -> None:
        super().__init__(run)
        self.visits, self.source = visits or Planner(run), source or LayerSource(run)
        self.steps = StepDrawing(run, self.source, target)
        self.live = live or LiveBlock(run)
        self._pace = Pace(run.optimizers, run.config.recipe.batch_power)

    # -- a step --------------------------------------------------------------------------------------

    @property
    def batch(self) -> int:
        """Views in a step of the visit that is under way."""
        return self.steps.batch

    def next_batch(self) -> Batch:
        """Begin a visit if none is under way, set the learning rates, and say what to train on next.

        Raises:
            NothingSeenError: no view sees any block.
        """
        self.stopwatch.start()
        if self.state.active is None:
            self.begin_visit()
        decay = exponential_decay(self.run.share, 1.0, self.config.means_lr_decay)
        self._pace.set(self.batch, means_decay=decay, damping=self.health.damping)
        return self.steps.next_batch()

    def render(self, batch: Batch) -> Rendered:
        """Draw the active block between its layers; differentiable in the live parameters."""
        return self.steps.render(batch)

    def loss(
        self,
        batch: Batch,
        pictures: Sequence[Float[Tensor, "_h _w 3"]],
        photos: Sequence[Float[Tensor, "_h _w 3"]],
    ) -> Float[Tensor, ""]:
        """The loss of a step, helpers' part included, over what says something about the block."""
        return self.steps.loss(batch, *self.visits.compared(batch, pictures, photos))

    def after_step(self, rendered: Rendered, psnrs: Sequence[Tensor] = ()) -> None:
        """Call after the optimizers stepped: grows and prunes, and ends the visit when its steps are done.

        Args:
            psnrs: of each picture, dB; listeners are told their mean.
        """
        active, taken = self.run.active, len(rendered.pictures) * self.run.active.crew
        self.state.step += 1
        active.done += 1
        sound, psnr = self.health.end_step(psnrs)
        self.live.count_step(self.batch, 0 if active.is_whole else taken)
        if not active.is_whole:
            infos = rendered.infos if sound else ()
            clock = self.live.density_clock(taken, self.batch, self.visits.room())
            self.live.refine(infos, clock, self.steps.contributions() if infos else ())
            if self.live.is_due_to_shed(taken):
                self.live.shed()
        self.announce(StepTaken(self.state.step, active.number, active.done, psnr))
        if self._is_over(active):
            self.end_visit()
        elif self.scene.is_due(self.config.commit_seconds):
            self.rest(self.config.commit_seconds)

    def _is_over(self, active: ActiveVisit) -> bool:
        is_warm = active.is_whole and self.progress >= self.config.warmup
        out_of_time = self.finished or self.progress >= active.until
        return active.done >= active.steps or out_of_time or is_warm or self.live.has_outgrown

    # -- a visit -------------------------------------------------------------------------------------

    def begin_visit(self) -> None:
        """Begin the next one."""
        active = self.visits.begin()
        active.crew = self.steps.size_of_crew(active)
        self._attach(active)

    def _attach(self, active: ActiveVisit) -> None:
        self.live.attach(active, self.batch)
        block, seen = None if active.is_whole else active.geometry.block, len(active.geometry.views)
        self.scene.set_live(block, self.visits.attached(active))
        state, gaussians = self.state, len(self.live)
        self.announce(VisitBegan(active.number, state.sweep, block, active.steps, seen, gaussians))
        before = self.stopwatch.seconds
        self.steps.begin_visit(active)
        active.layer_seconds += self.stopwatch.seconds - before
        if active.done == 0 and self.steps.layers is not None:
            state.count_drawn(gaussians, self.steps.layers.frozen)
        if active.done == 0 and active.looked_at:
            state.influence[block].update(self.steps.shown_in(active.looked_at))
        for plan in state.queue[:1]:
            self.scene.read_ahead(plan.block)

    def end_visit(self) -> None:
        """Put the block to rest, and Gaussians that left it into the inbox; cut what has outgrown a block."""
        active = self.run.active
        if not active.is_whole:
            if not active.sole:
                self.live.shed()
            self.live.count_visit()
        state = self.health.end_visit(active, self.live.detached)
        if active.is_whole:
            self._end_warm_up()
        updates = settle(self.scene, active.geometry.block, state, self.config.recipe.migrate)
        limits = self.config.limits.block_limit, self.config.limits.sole_limit
        tree, updates = cut_full(self.scene, updates, self.state, *limits, self.announce)
        if active.saved:
            updates[LIVE] = state.nobody
        self.scene.clear_live()
        self.steps.end_visit()
        self.state.active = None
        crash_points.reached(crash_points.VISIT_TRAINED)
        split = tree is not self.scene.tree
        self.run.rest(tree, updates, 0.0 if self.finished else self.config.commit_seconds)
        if split:
            self.run.fit_density(tree.num_blocks)
        self._tell_of_end(active, state, updates)

    def _end_warm_up(self) -> None:
        """From now on it is known what views show of which block."""
        run = self.run
        self.state.warm = min(self.progress, self.config.warmup)
        live, views = live_gaussians(self.params).detach(), self.views.values()
        owner, options = self.scene.tree.assign(live.means), {"antialiased": self.config.antialiased}
        self.state.influence = influence(live, owner, views, run.rasterizer, **options)

    def _tell_of_end(self, active: ActiveVisit, state: BlockState, updates: dict[int, BlockState]) -> None:
        block = None if active.is_whole else active.geometry.block
        staying = len(state) if block is None else len(updates[block])
        self.announce(
            VisitEnded(
                active.number,
                self.state.sweep,
                block,
                gaussians=staying,
                migrated=len(state) - staying,
                layer_seconds=active.layer_seconds,
                seconds=self.stopwatch.seconds - active.began,
            )
        )
        if not active.is_whole and not self.state.queue:
            self.announce(SweepEnded(self.state.sweep, self.state.step))

    # -- at rest -------------------------------------------------------------------------------------

    @property
    def layer_limit(self) -> int:
        """Bytes that layers may take, on the device and in RAM."""
        return self.source.room.total

    @property
    def layer_bytes(self) -> int:
        """Bytes that the layers of the visit that is under way take; helpers' are not among them."""
        return self.steps.layers.nbytes if self.steps.layers else 0

    def rest(self, within: float) -> None:
        """Put the live block to rest under a number of its own, and the run's state."""
        updates = {}
        if (active := self.state.active) is not None:
            self.health.look_over()
            updates = {LIVE: self.live.detached()}
            active.saved = True
        self.run.rest(self.scene.tree, updates, within)

    def restore(self) -> None:
        """Go on from the store's newest generation: where `save` was called, or something was put to rest."""
        self.run.restore()
        if self.state.active is not None:
            self._attach(self.state.active)
