"""The training of one visit's block, from its first step to its last: by whoever has the block."""

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.events import StepTaken, VisitBegan
from abcd_ns.engine.gaussians.block_state import BlockState
from abcd_ns.engine.gaussians.param_swap import Pace
from abcd_ns.engine.space.influence import InfluenceTable
from abcd_ns.engine.store.special_blocks import RESERVE
from abcd_ns.engine.train.capture.light import AMONG_OTHERS, LAST, gradients_of
from abcd_ns.engine.train.layer_source import LayerSource
from abcd_ns.engine.train.planner import Visits
from abcd_ns.engine.train.run import TrainingRun
from abcd_ns.engine.train.run_state import ActiveVisit
from abcd_ns.engine.train.schedule import exponential_decay, settling, warm_up_is_over
from abcd_ns.engine.train.step.batch import Batch, Rendered
from abcd_ns.engine.train.step.drawing import StepDrawing
from abcd_ns.engine.train.step.live_block import LiveBlock


class VisitTraining:
    """Attaches a block between its layers, takes its steps, and gives back what they made of it.

    Args:
        visits: on what terms the block is trained.
        source: gives visits their layers.
        live: the block in training; None for one that nobody else looks after.
    """

    def __init__(
        self,
        run: TrainingRun,
        visits: Visits,
        source: LayerSource,
        live: LiveBlock | None = None,
    ) -> None:
        self.run, self._visits = run, visits
        self.steps = StepDrawing(run, source)
        self.live = LiveBlock(run) if live is None else live  # one that is empty yet is false
        self.influence: InfluenceTable | None = None
        """In the warm-up: what its drawings show of every block."""
        self._pace = Pace(run.optimizers, run.config.recipe.batch_power, run.config.recipe.fast_start)

    @property
    def batch(self) -> int:
        """Views in a step of the visit that is under way."""
        return self.steps.batch

    def attach(self, active: ActiveVisit) -> None:
        """Make the block of the run's active visit live and draw its layers, at its beginning or where a save
        found it."""
        run, state = self.run, self.run.state
        self.live.attach(active, self.batch)
        block, seen = None if active.is_whole else active.geometry.block, len(active.trained_on)
        run.scene.set_live(block, self._visits.attached(active, run.params))
        gaussians, self.influence = len(self.live), None
        if active.is_whole:
            self.influence = InfluenceTable(run.scene.tree, run.views, state.influence, run.device)
        run.announce(VisitBegan(active.number, state.sweep, block, active.steps, seen, gaussians))
        before = run.stopwatch.seconds
        self.steps.begin_visit(active)
        active.layer_seconds += run.stopwatch.seconds - before
        if active.done == 0 and self.steps.layers is not None:
            state.count_drawn(gaussians, self.steps.layers.frozen)
        if active.done == 0 and active.looked_at:
            state.influence[block].update(self.steps.shown_in(active.looked_at))

    def next_batch(self) -> Batch:
        """Set the learning rates, and say what to train on next."""
        run = self.run
        decay = exponential_decay(run.share, 1.0, run.config.means_lr_decay)
        # A first visit, perhaps the only one, has all.
        settles = run.config.recipe.fast_start and (run.active.sole or self.live.clocks.visits > 0)
        trained = self.live.clocks.adam_views
        damping = run.health.damping * (settling(run.progress, trained) if settles else 1.0)
        self._pace.set(self.batch, trained, decay, damping)
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
        """The loss of a step, over what says something about the block."""
        return self.steps.loss(batch, *self._visits.compared(batch, pictures, photos))

    def after_step(self, rendered: Rendered, psnrs: Sequence[Tensor] = ()) -> None:
        """Call after the optimizers stepped: grows and prunes.

        Args:
            psnrs: of each picture, dB; listeners are told their mean.
        """
        run, active = self.run, self.run.active
        taken = len(rendered.pictures)
        self._adapt_light(rendered)
        self._note_influence(rendered)
        run.state.step += 1
        active.done += 1
        sound, psnr = run.health.end_step(psnrs)
        self.live.count_step(self.batch, taken)
        clock = self.live.density_clock(taken, self.batch, self._visits.room())
        self.live.refine(rendered.infos if sound else (), clock)
        if self.live.is_due_to_shed(taken):
            self.live.shed()
            self.live.lower_degrees()
            self.live.hold_back_giants()
        run.announce(StepTaken(run.state.step, active.number, active.done, psnr))

    def _note_influence(self, rendered: Rendered) -> None:
        """Views of several sizes may have another order in the infos, and of those that are drawn in part
        only a part is told: they are drawn again afterwards."""
        if self.influence is None or len(rendered.infos) != 1 or "weights" not in rendered.infos[0]:
            return
        most = self.run.config.limits.crop_pixels
        if most and any(view.full.pixels > most for view in rendered.views):
            return
        weights = rendered.infos[0]["weights"].grad
        if weights is not None:
            self.influence.note(self.run.params["means"], rendered.views, weights)

    def _adapt_light(self, rendered: Rendered) -> None:
        run = self.run
        if run.light is None:
            return
        damping = exponential_decay(run.progress, 1.0, LAST)
        share = 1.0 if run.active.is_alone else AMONG_OTHERS
        run.light.step(gradients_of(rendered.lights), share * damping)

    @property
    def is_over(self) -> bool:
        """Whether the visit has had all its steps or time, or its block has outgrown the device."""
        run, active = self.run, self.run.active
        out_of_time = run.progress >= min(active.until, 1.0)
        return active.done >= active.steps or out_of_time or self._is_warm or self.live.has_outgrown

    @property
    def _is_warm(self) -> bool:
        run, active = self.run, self.run.active
        if not active.is_whole:
            return False
        uses, waiting = active.done * self.batch / len(active.views), run.scene.rows(RESERVE)
        return warm_up_is_over(run.progress, uses, run.config.warmup, waiting)

    def finish(self) -> BlockState:
        """What the visit has made of its block, on the CPU; its layers go."""
        active = self.run.active
        if not active.is_all:
            self.live.shed()
            self.live.lower_degrees()
        self.live.hold_back_giants()
        if not active.is_whole:
            self.live.count_visit()
        state = self.run.health.end_visit(active, self.live.detached)
        self.steps.end_visit()
        return state
