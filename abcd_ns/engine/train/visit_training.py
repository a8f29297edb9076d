"""The training of one visit's block, in whichever process has the block."""

from collections.abc import Sequence
from dataclasses import replace

from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.events import PhotosWanted, StepTaken, VisitBegan
from abcd_ns.engine.gaussians.block_state import BlockState
from abcd_ns.engine.gaussians.param_swap import Pace, active_gaussians
from abcd_ns.engine.layers.visit_layers import VisitLayers
from abcd_ns.engine.render import Raster
from abcd_ns.engine.render.pictures import pictures_of
from abcd_ns.engine.space.influence import InfluenceTable, share_shown
from abcd_ns.engine.store.special_blocks import DEFERRED
from abcd_ns.engine.train import schedule
from abcd_ns.engine.train.capture.light import AMONG_OTHERS, LAST_RATE, Light
from abcd_ns.engine.train.density.pruning import PASSES, with_blend_weights
from abcd_ns.engine.train.planner import Visits
from abcd_ns.engine.train.run import TrainingRun
from abcd_ns.engine.train.run_state import ActiveVisit
from abcd_ns.engine.train.step.active_block import ActiveBlock
from abcd_ns.engine.train.step.batch import (
    COMING,
    Backgrounds,
    Batch,
    Pictures,
    Rendered,
    Residuals,
    Sample,
    part_to_draw,
)
from abcd_ns.engine.train.step.dropout import dropout_at, thinned
from abcd_ns.engine.train.step.layer_source import LayerRoom, layers_of_visit


class VisitTraining:
    """Attaches a block between its layers, takes its steps, and gives back what they made of it."""

    def __init__(self, run: TrainingRun, visits: Visits, room: LayerRoom) -> None:
        self.run, self._visits, self._room = run, visits, room
        self.block = ActiveBlock(run)
        self.layers: VisitLayers | None = None
        self.influence: InfluenceTable | None = None
        """In the warm-up: what its drawings show of every block."""
        late = run.config.limits.late_harmonics > 0
        self._pace = Pace(run.optimizers, run.config.recipe.fast_start, late)
        self._backgrounds = Backgrounds(run.config, run.device)
        self._order: tuple[int, ...] = ()
        self._reach = 1.0
        self._rendered: Rendered | None = None
        self._residuals = Residuals()

    @property
    def batch(self) -> int:
        """Views in a step of the visit that is under way; the most that one draws where none is."""
        active = self.run.state.active
        most = schedule.views_per_step(self.run.config.batch, self.run.blocks)
        return most if active is None else active.batch or most

    def attach(self, active: ActiveVisit) -> None:
        """Make the visit's block active and draw its layers, at its beginning or where a save found it."""
        run, state = self.run, self.run.state
        self.block.attach(active, self.batch, max(active.sh_degree, self.degree))
        block, seen = None if active.is_whole else active.geometry.block, len(active.trained_on)
        self._reach = run.reach(active.trained_on)
        run.scene.set_active(block, self._visits.attached(active, run.params), run.config.sh_degree)
        self.influence = None
        if active.is_whole:
            self.influence = InfluenceTable(run.scene.tree, run.views, state.influence, run.device)
        run.announce(VisitBegan(active.number, state.epoch, block, active.steps, seen, len(self.block)))
        before = run.stopwatch.seconds
        # None where nobody knows how many steps it will have, and its views are drawn in turn.
        taken = 0 if active.is_alone else active.steps * self.batch
        self._order = schedule.view_order(active.views, taken, active.number, run.config.seed)
        self.layers = layers_of_visit(run, self._room, active, self._order[active.done * self.batch :])
        active.layer_seconds += run.stopwatch.seconds - before
        for view in active.looked_at if active.done == 0 else ():
            whole, gaussians = self.whole(view), active_gaussians(run.params)
            state.influence[block][view] = share_shown(
                gaussians, run.rasterizer, whole.shot, whole.in_front, antialiased=run.config.antialiased
            )

    def next_batch(self) -> Batch:
        """As Trainer.next_batch; listeners are told the views of the steps to come, too."""
        run = self.run
        if run.active.is_alone:
            self.block.raise_degree(self.degree)
        decay = schedule.exponential_decay(run.share, run.config.recipe.means_lr_decay) * self._reach
        # A first visit, perhaps the only one, has all.
        decays = run.config.recipe.fast_start and (run.active.is_joint or self.block.clocks.visits > 0)
        trained = self.block.clocks.adam_views + run.config.recipe.trained_before
        damping = schedule.final_decay(run.progress, trained) if decays else 1.0
        self._pace.set(self.batch, trained, decay, damping)
        first = run.active.done * self.batch
        views = self._views_of(range(first, first + self.batch + COMING))
        run.announce(PhotosWanted(views))
        samples = tuple(self._sample(view, place) for place, view in enumerate(views[: self.batch]))
        return Batch(samples, run.config.limits.batch_limit)

    def render(self, batch: Batch) -> Rendered:
        """Draw the active block between its layers; differentiable in its parameters."""
        rendered = self._rendered = self._draw(batch.samples)
        if not self.run.active.shown:
            for sample, raster in zip(batch.samples, rendered.rasters, strict=True):
                self.run.health.see(sample.in_front, raster.transmittance)
        return rendered

    def loss(self, batch: Batch, pictures: Pictures, photos: Pictures) -> Float[Tensor, ""]:
        """As Trainer.loss, over what of the crops says something about the block."""
        pictures, photos = self._visits.compared(batch, pictures, photos)
        self._residuals.ask(self._rendered, batch.samples, pictures, photos)
        self._rendered = None
        return batch.loss(pictures, photos, self.run.config)

    def gathered(self, rendered: Rendered) -> Rendered:
        """As Trainer.gathered."""
        self.block.gather(rendered.infos, self._residuals.found())
        return replace(rendered, infos=())

    def after_step(self, rendered: Rendered, errors: Sequence[Tensor] = ()) -> None:
        """As Trainer.after_step: grows and prunes."""
        run, active = self.run, self.run.active
        self._adapt_light(rendered)
        self._note_influence(rendered)
        run.state.step += 1
        active.done += 1
        sound, psnr = run.health.end_step(errors)
        judged = self._residuals.found()
        infos, judged = (rendered.infos, judged) if sound else ((), ())
        clock = self.block.after_step(len(rendered.views), self.batch, self._visits.room(), infos, judged)
        if active.is_all and clock.reached(PASSES * len(active.geometry.views)):
            self.block.prune()
        run.announce(StepTaken(run.state.step, active.number, active.done, psnr))

    def _note_influence(self, rendered: Rendered) -> None:
        """But not of views of several sizes, whose order may differ in infos, nor of views drawn in part."""
        most = self.run.config.limits.crop_pixels
        in_part = most and any(view.full.pixels > most for view in rendered.views)
        if self.influence is None or in_part or len(rendered.infos) != 1:
            return
        weights = rendered.infos[0].get("weights")
        if weights is not None and weights.grad is not None:
            self.influence.note(self.run.params["means"], rendered.views, weights.grad)

    def _adapt_light(self, rendered: Rendered) -> None:
        run = self.run
        if not isinstance(run.light, Light):
            return
        damping = schedule.exponential_decay(run.progress, LAST_RATE)
        share = 1.0 if run.active.is_alone else AMONG_OTHERS
        lights = zip(rendered.views, rendered.lights, strict=True)
        gradients = [(view.index, light.grad) for view, light in lights if light.grad is not None]
        run.light.step(gradients, share * damping)

    @property
    def is_over(self) -> bool:
        """Whether the visit has had all its steps or time, or its block has outgrown the device."""
        run, active = self.run, self.run.active
        out_of_time = run.progress >= min(active.until, 1.0)
        if active.is_whole:
            uses, deferred = active.done * self.batch / len(active.views), run.scene.rows(DEFERRED)
            out_of_time |= schedule.warm_up_is_over(run.progress, uses, run.config.warmup, deferred)
        grown = active.is_joint and self.block.clocks.refined == self.block.clocks.steps
        outgrown = grown and run.limits.is_full(len(self.block), blocks=1)
        return active.done >= active.steps or out_of_time or outgrown

    def finish(self) -> BlockState:
        """What the visit has made of its block, on the CPU; its layers go."""
        active = self.run.active
        if not active.is_all and not self.block.is_new:
            self.block.prune()
        self.block.end_visit(counts=not active.is_whole)
        state = self.block.detached()
        self.run.health.end_visit()
        self.layers = None
        return state

    def whole(self, view: int) -> Sample:
        """All that a view shows of the block in this visit."""
        return self._sample(view, 0, in_part=False)

    @property
    def degree(self) -> int:
        active = self.run.active
        changes = active.is_alone or self.run.config.recipe.sh_restart
        return self.run.sh_degree if changes else active.sh_degree

    def _views_of(self, places: range) -> tuple[int, ...]:
        """The views at these places of the visit; fewer where it ends before."""
        if not self._order:
            views, seed = self.run.active.views, self.run.config.seed
            return tuple(schedule.endless_order(views, place, seed) for place in places)
        return self._order[places.start : places.stop]

    def _sample(self, view: int, place: int, *, in_part: bool = True) -> Sample:
        """What is drawn at one place of a step: all that a view shows of the block, or a part."""
        run, active, step = self.run, self.run.active, self.run.state.step
        seen = run.views_at(run.reduction)[view]
        if self.layers and not self.layers.shows(seen):
            raise RuntimeError(f"View {view} has moved since its layers were drawn.")
        whole = seen.full if active.is_all else active.geometry.crops[view]
        crop = part_to_draw(run.config, whole, step, place) if in_part else whole
        layers, window = self.layers.around(view, crop) if self.layers else (None, None)
        behind = self._backgrounds.at(step, place)
        return Sample(seen, crop, layers, window, behind, share=crop.pixels / whole.pixels)

    def _draw(self, samples: Sequence[Sample]) -> Rendered:
        run, gaussians = self.run, active_gaussians(self.run.params)
        if run.active.is_all:
            uses = self.block.clocks.adam_views / len(run.views)
            rate = dropout_at(run.share, len(run.views), uses, run.config.recipe.dropout)
            gaussians = thinned(gaussians, rate, f"dropout {run.config.seed} {run.state.step}")
        rasters = run.rasterizer.draw(
            gaussians,
            [sample.shot for sample in samples],
            sh_degree=min(self.degree, gaussians.sh_degree),  # by time, it may have risen since `next_batch`
            antialiased=run.config.antialiased,
            blend_weights=run.density.config.prunes,
            residual_sums=run.density.asks(run.share, first=self.block.clocks.visits == 0),
        )
        infos = tuple({id(raster.info): raster.info for raster in rasters}.values())
        views = tuple(sample.view for sample in samples)
        lights = tuple(None if run.light is None else run.light.of(view.index) for view in views)
        pictures = None
        if run.light is None:
            pictures = pictures_of(
                rasters, [sample.surroundings(run.density.config.prunes) for sample in samples]
            )
        if pictures is None:
            pictures = tuple(map(self._picture, samples, rasters, lights))
        return Rendered(pictures, rasters, infos, lights, views)

    def _picture(self, sample: Sample, raster: Raster, light: Tensor | None) -> Tensor:
        if self.run.density.config.prunes:
            raster = with_blend_weights(raster, sample.in_front, sample.share)
        return sample.picture(raster, light)
