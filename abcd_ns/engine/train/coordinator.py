"""Block coordinate descent: visits blocks one after the other and trains each within its surroundings.

`Visits` decides on the blocks, `VisitTraining` trains them. What is not active is stored.
"""

from collections.abc import Callable, Iterable, Sequence

from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.events import EpochEnded, VisitEnded
from abcd_ns.engine.gaussians.block_state import BlockState
from abcd_ns.engine.space.influence import Influence, influence
from abcd_ns.engine.space.tree import BlockTree
from abcd_ns.engine.store import crash_points
from abcd_ns.engine.store.commit import commit
from abcd_ns.engine.store.special_blocks import ACTIVE, BlockName
from abcd_ns.engine.train.planner import Planner, Visits
from abcd_ns.engine.train.run import TrainingRun
from abcd_ns.engine.train.run_state import ActiveVisit
from abcd_ns.engine.train.step.batch import Batch, Pictures, Rendered, Sample, Target
from abcd_ns.engine.train.step.final_pruning import FinalPruning
from abcd_ns.engine.train.step.layer_source import LayerRoom
from abcd_ns.engine.train.step.pose_rounds import PoseRounds
from abcd_ns.engine.train.trainer import Trainer
from abcd_ns.engine.train.visit_training import VisitTraining

AT_ONCE = 1e-3
"""Seconds: what a long visit persists is written as soon as no other write is under way."""


class Coordinator(Trainer):
    """Trains one block after the other.

    Args:
        visits: decides which; None for ABCD's own.
        room: for layers; None for little, on the device.
        target: gives what a sample is trained on; needed to refine poses, and for a final pruning.
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
        self.layer_limit = self.room.device + self.room.ram
        self.visit = VisitTraining(run, self.visits, self.room)
        if run.config.poses != "off" and target is None:
            raise ValueError("poses are refined by photos: give `target`")
        self.poses = None if run.config.poses == "off" else PoseRounds(run, target)
        prunes = target is not None and run.density.config.prunes
        self._final_pruning = FinalPruning(run, target) if prunes else None

    @property
    def batch(self) -> int:
        return self.visit.batch

    def next_batch(self) -> Batch:
        """Begin a visit if none is under way; see Trainer. A NothingSeenError if no view sees any block."""
        self.stopwatch.start()
        # Before a step, not after one: a run that stops between two goes on to the same round.
        if self.poses is not None and self.poses.is_due:
            self.poses.take()
        if self.state.active is None:
            self._attach(self.visits.begin())
        return self.visit.next_batch()

    def render(self, batch: Batch) -> Rendered:
        return self.visit.render(batch)

    def loss(self, batch: Batch, pictures: Pictures, photos: Pictures) -> Float[Tensor, ""]:
        return self.visit.loss(batch, pictures, photos)

    def gathered(self, rendered: Rendered) -> Rendered:
        return self.visit.gathered(rendered)

    def after_step(self, rendered: Rendered, errors: Sequence[Tensor] = ()) -> None:
        """Grow and prune, and end the visit when its steps are done."""
        if self.poses is not None:
            self.poses.count(len(rendered.views))
        self.visit.after_step(rendered, errors)
        if self.visit.is_over:
            self.end_visit()
        elif self.scene.is_due(self.config.commit_seconds):
            self.persist(AT_ONCE)

    @property
    def finished(self) -> bool:
        """Whether the budget is used up, and no block is active."""
        return self.state.active is None and super().finished

    def _attach(self, active: ActiveVisit) -> None:
        self.visit.attach(active)
        for plan in self.state.queue[:1]:
            self.scene.read_ahead(plan.block)

    def end_visit(self) -> None:
        """Persist the block, and what left it as pending migrants; cut what has outgrown a block."""
        active = self.run.active
        state = self.visit.finish()
        self.visit.block.let_go()  # a worker, or the next footprints, may need the device's memory
        if active.is_whole:  # from now on it is known what views show of which block
            known, unknown = self.visit.influence.found()
            self.visit.influence = None  # it holds on to what was active
            others = self._influence(state, self.scene.tree, sorted(unknown))
            self.state.influence = {b: known.get(b, {}) | others.get(b, {}) for b in {**known, **others}}
        updates = commit(self.scene, active.geometry.block, state, self.config.recipe.migrate)
        if active.saved:
            updates[ACTIVE] = state.nobody
        self.scene.clear_active()
        self.state.active = None
        crash_points.reached(crash_points.VISIT_TRAINED)
        self.persist_visit(active, state, updates, self.state.epoch)
        if not active.is_whole and not self.state.queue:
            self.announce(EpochEnded(self.state.epoch, self.state.step))

    def complete(self) -> None:
        """End a visit that is under way, and prune for the last time if options and photos allow."""
        if self.state.active is not None:
            self.end_visit()
        if self._final_pruning is not None and self.state.pruned_at != self.state.step:
            self._final_pruning.run()
            self.state.pruned_at = self.state.step
            self.run.persist(self.scene.tree, {}, 0.0)

    def _influence(self, scene: BlockState, tree: BlockTree, views: Iterable[int]) -> Influence:
        """The influence of every block of the whole scene on these views."""
        run, gaussians = self.run, scene.gaussians.to(self.device)
        shown, owner = [run.views[view] for view in views], tree.assign(gaussians.means)
        return influence(gaussians, owner, shown, run.rasterizer, antialiased=run.config.antialiased)

    @property
    def layer_bytes(self) -> int:
        return self.visit.layers.nbytes if self.visit.layers else 0

    def persist_visit(
        self, active: ActiveVisit, state: BlockState, updates: dict[BlockName, BlockState], epoch: int
    ) -> None:
        """Persist what a visit changed: the `updates` made of `state`, its block as trained. Cut blocks that
        have outgrown their limit, and tell listeners."""
        run = self.run
        tree, parts = run.cut(updates)
        if active.is_joint and tree.num_blocks > 1:
            run.state.influence = self._influence(state, tree, run.views)
        run.persist(tree, parts, 0.0 if run.progress >= 1.0 else run.config.commit_seconds)
        block = None if active.is_whole else active.geometry.block
        staying = len(state) if block is None else len(updates[block])
        migrated, took = len(state) - staying, run.stopwatch.seconds - active.began
        run.announce(VisitEnded(active.number, epoch, block, staying, migrated, active.layer_seconds, took))

    def persist(self, within: float) -> None:
        """Persist the active block under a name of its own, and the run's state."""
        updates = {}
        if (active := self.state.active) is not None:
            updates = {ACTIVE: self.visit.block.detached().unpinned()}
            active.saved = True
            if self.visit.influence is not None:
                self.state.influence, _ = self.visit.influence.found()
        self.run.persist(self.scene.tree, updates, within)

    def restore(self) -> None:
        self.run.restore()
        if self.state.active is not None:
            self._attach(self.state.active)
