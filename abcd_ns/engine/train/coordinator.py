"""Block coordinate descent: visits blocks one after the other and trains each within its surroundings.

`Visits` gives the coordinator its blocks, `VisitTraining` their gradients. What is not active is stored.
Listeners are told what happens.
"""

from collections.abc import Callable, Iterable, Sequence

from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.events import EpochEnded, VisitEnded
from abcd_ns.engine.gaussians.block_state import BlockState
from abcd_ns.engine.gaussians.param_swap import active_gaussians
from abcd_ns.engine.space.influence import Influence, influence
from abcd_ns.engine.space.tree import BlockTree
from abcd_ns.engine.store import crash_points
from abcd_ns.engine.store.commit import commit
from abcd_ns.engine.store.special_blocks import ACTIVE, BlockName
from abcd_ns.engine.train.density.splitting import cut_full
from abcd_ns.engine.train.layer_source import LayerRoom
from abcd_ns.engine.train.planner import Planner, Visits
from abcd_ns.engine.train.run import TrainingRun
from abcd_ns.engine.train.run_state import ActiveVisit
from abcd_ns.engine.train.step.batch import Batch, Pictures, Rendered, Sample, Target
from abcd_ns.engine.train.step.final_pruning import FinalPruning
from abcd_ns.engine.train.step.pose_rounds import PoseRounds
from abcd_ns.engine.train.trainer import Trainer
from abcd_ns.engine.train.visit_training import VisitTraining
from abcd_ns.engine.types import Gaussians

AT_ONCE = 1e-3
"""Seconds: what a long visit persists is written as soon as no other write is under way. The last one may
have begun just now with a state of long ago; to count from that, a kill would lose twice `commit_seconds`."""


class Coordinator(Trainer):
    """Trains one block after the other.

    Args:
        visits: decides which; None for ABCD's own.
        room: for layers; None for little, on the device.
        target: gives what a sample is trained on; needed where poses are refined, and for a final pruning.
    """

    def __init__(
        self,
        run: TrainingRun,
        visits: Visits | None = None,
        room: LayerRoom | None = None,
        target: Callable[[Sample], Target] | None = None,
    ) -> None:
        super().__init__(run)
        self.visits, self.room = visits or Planner(run), room or LayerRoom()
        self.visit = VisitTraining(run, self.visits, self.room)
        if run.config.poses != "off" and target is None:
            raise ValueError("poses are refined by photos: give `target`")
        self.poses = None if run.config.poses == "off" else PoseRounds(run, target)
        self._final_pruning = None if target is None else FinalPruning(run, target)

    # -- a step --------------------------------------------------------------------------------------

    @property
    def batch(self) -> int:
        """Views in a step of the visit that is under way; the most that one draws where none is."""
        return self.visit.batch

    def next_batch(self) -> Batch:
        """Begin a visit if none is under way, set the learning rates, and say what to train on next.

        Raises:
            NothingSeenError: no view sees any block.
        """
        self.stopwatch.start()
        # Before a step, not after one: a run that stops between two goes on to the same round.
        if self.poses is not None and self.poses.is_due:
            self.poses.take()
        if self.state.active is None:
            self.begin_visit()
        return self.visit.next_batch()

    def render(self, batch: Batch) -> Rendered:
        """Draw the active block between its layers; differentiable in its parameters."""
        return self.visit.render(batch)

    def loss(self, batch: Batch, pictures: Pictures, photos: Pictures) -> Float[Tensor, ""]:
        """What a batch adds to the loss of a step, over what says something about the block."""
        return self.visit.loss(batch, pictures, photos)

    def after_step(self, rendered: Rendered, errors: Sequence[Tensor] = ()) -> None:
        """Call after the optimizers stepped: grows and prunes, and ends the visit when its steps are done.

        Args:
            errors: the mean squared one of each picture; listeners are told the mean PSNR.
        """
        if self.poses is not None:
            self.poses.count(len(rendered.views))
        self.visit.after_step(rendered, errors)
        if self.visit.is_over:
            self.end_visit()
        elif self.scene.is_due(self.config.commit_seconds):
            self.persist(AT_ONCE)

    @property
    def finished(self) -> bool:
        """Whether the budget is used up, and no block is active. Seconds may run out just after a visit was
        found not to be over; then it takes one more step."""
        return self.state.active is None and super().finished

    # -- a visit -------------------------------------------------------------------------------------

    def begin_visit(self) -> None:
        """Begin the next one."""
        self.visit.attach(self.visits.begin())
        self._read_ahead()

    def _read_ahead(self) -> None:
        for plan in self.state.queue[:1]:
            self.scene.read_ahead(plan.block)

    def end_visit(self) -> None:
        """Persist the block, and what left it as pending migrants; cut what has outgrown a block."""
        active = self.run.active
        state = self.visit.finish()
        if active.is_whole:
            self._end_warm_up()
        self.visit.block.let_go()  # a worker, or the next footprints, may need the device's memory
        updates = commit(self.scene, active.geometry.block, state, self.config.recipe.migrate)
        if active.saved:
            updates[ACTIVE] = state.nobody
        self.scene.clear_active()
        self.state.active = None
        crash_points.reached(crash_points.VISIT_TRAINED)
        persist_after_visit(self.run, active, state, updates, self.state.epoch)
        if not active.is_whole and not self.state.queue:
            self.announce(EpochEnded(self.state.epoch, self.state.step))

    def complete(self) -> None:
        """Take out what the complete run's pictures hardly miss, where options ask for it and there are
        photos to tell. A run that resumes from a kill in its midst does it anew, with what is left by then. A
        visit that is under way, as where a run goes on for no more steps, ends."""
        if self.state.active is not None:
            self.end_visit()
        if (
            self.state.pruned_at == self.state.step
            or self._final_pruning is None
            or not self._final_pruning.is_wanted
        ):
            return
        self._final_pruning.run()
        self.state.pruned_at = self.state.step
        self.run.persist(self.scene.tree, {}, 0.0)

    def _end_warm_up(self) -> None:
        """From now on it is known what views show of which block."""
        known, unknown = self.visit.influence.found()
        self.visit.influence = None  # it holds on to what was active
        others = influence_on(
            self.run, active_gaussians(self.params).detach(), self.scene.tree, sorted(unknown)
        )
        self.state.influence = {b: known.get(b, {}) | others.get(b, {}) for b in {**known, **others}}

    # -- persist and restore -------------------------------------------------------------------------

    @property
    def layer_limit(self) -> int:
        """Bytes that layers may take, on the device and in RAM."""
        return self.room.total

    @property
    def layer_bytes(self) -> int:
        """Bytes that the layers of the visit that is under way take."""
        return self.visit.layers.nbytes if self.visit.layers else 0

    def persist(self, within: float) -> None:
        """Persist the active block under a name of its own, and the run's state."""
        updates = {}
        if (active := self.state.active) is not None:
            self.health.look_over()
            updates = {ACTIVE: self.visit.block.detached().unpinned()}
            active.saved = True
            if self.visit.influence is not None:
                self.state.influence, _ = self.visit.influence.found()
        self.run.persist(self.scene.tree, updates, within)

    def restore(self) -> None:
        """Go on from the store's newest generation: where `save` was called, or something was persisted."""
        self.run.restore()
        if self.state.active is not None:
            self.visit.attach(self.state.active)
            self._read_ahead()


def influence_on(run: TrainingRun, whole: Gaussians, tree: BlockTree, views: Iterable[int]) -> Influence:
    """The influence of every block on these views.

    Args:
        whole: all Gaussians of the scene, on the device.
    """
    shown = [run.views[view] for view in views]
    owner = tree.assign(whole.means)
    return influence(whole, owner, shown, run.rasterizer, antialiased=run.config.antialiased)


def persist_after_visit(
    run: TrainingRun, active: ActiveVisit, state: BlockState, updates: dict[BlockName, BlockState], epoch: int
) -> None:
    """Persist what a visit changed, blocks that have outgrown their limit in parts, and tell listeners.

    Args:
        state: what the visit made of its block.
        updates: what is persisted of it.
        epoch: that it belongs to.
    """
    tree, parts = cut_full(run.scene, updates, run.state, run.limits, run.announce)
    if active.is_joint and tree.num_blocks > 1:
        run.state.influence = influence_on(run, state.gaussians.to(run.device), tree, run.views)
    run.persist(tree, parts, 0.0 if run.progress >= 1.0 else run.config.commit_seconds)
    block = None if active.is_whole else active.geometry.block
    staying = len(state) if block is None else len(updates[block])
    run.announce(
        VisitEnded(
            active.number,
            epoch,
            block,
            gaussians=staying,
            migrated=len(state) - staying,
            layer_seconds=active.layer_seconds,
            seconds=run.stopwatch.seconds - active.began,
        )
    )
