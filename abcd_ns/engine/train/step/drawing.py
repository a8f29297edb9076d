"""Draws the steps of a visit, and takes their loss."""

from collections.abc import Sequence
from dataclasses import replace

from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.events import PhotosWanted
from abcd_ns.engine.gaussians.param_swap import live_gaussians
from abcd_ns.engine.layers.visit_layers import VisitLayers
from abcd_ns.engine.space.influence import share_shown
from abcd_ns.engine.train.capture.light import Use
from abcd_ns.engine.train.health.health_rules import share_of_picture
from abcd_ns.engine.train.layer_source import LayerSource
from abcd_ns.engine.train.run import TrainingRun
from abcd_ns.engine.train.run_state import ActiveVisit
from abcd_ns.engine.train.schedule import endless_order, view_order, views_per_step
from abcd_ns.engine.train.step.batch import COMING, Backgrounds, Batch, Rendered, Sample, part_to_draw
from abcd_ns.engine.train.step.normal_consistency import BEGINS, normal_consistency
from abcd_ns.engine.train.step.weighing import weighed
from abcd_ns.engine.types import Crop, View


class StepDrawing:
    """The active block between its layers, for the views of each step of a visit.

    Args:
        source: gives a visit its layers.
    """

    def __init__(self, run: TrainingRun, source: LayerSource) -> None:
        self._run, self._source = run, source
        self._backgrounds = Backgrounds(run.config, run.device)
        self._order: tuple[int, ...] = ()
        self.layers: VisitLayers | None = None

    # -- a visit -------------------------------------------------------------------------------------

    @property
    def batch(self) -> int:
        """Views in a step of the visit that is under way."""
        config = self._run.config
        return views_per_step(config.batch, self._run.blocks, config.limits.batch_limit)

    def begin_visit(self, active: ActiveVisit) -> None:
        """Draw layers; the block is live."""
        # None where nobody knows how many steps it will have, and its views are drawn in turn.
        taken = 0 if active.is_alone else active.steps * self.batch
        self._order = view_order(active.views, taken, active.number, self._run.config.seed)
        self.layers = self._source.draw(active, self._order[active.done * self.batch :])

    def end_visit(self) -> None:
        """Let go of layers."""
        self.layers = None

    def shown_in(self, views: Sequence[int]) -> dict[int, float]:
        """The influence that the block has on each of these views by now."""
        run, shown, live = self._run, {}, live_gaussians(self._run.params)
        for view in views:
            seen, options = self.whole(view), {"antialiased": run.config.antialiased}
            shown[view] = share_shown(live, run.rasterizer, seen.shot, seen.in_front, **options)
        return shown

    def _views_of(self, places: range) -> tuple[int, ...]:
        """What is drawn at these places of the visit; fewer where it ends before."""
        if not self._order:
            views, seed = self._run.active.views, self._run.config.seed
            return tuple(endless_order(views, place, seed) for place in places)
        return self._order[places.start : places.stop]

    # -- a step --------------------------------------------------------------------------------------

    def next_batch(self) -> Batch:
        """What to draw next; listeners are told the views of the steps to come, too."""
        step, first = self._run.state.step, self._run.active.done * self.batch
        views = self._views_of(range(first, first + self.batch + COMING))
        self._run.announce(PhotosWanted(views))
        now = enumerate(views[: self.batch])
        return Batch(step, tuple(self._sample(view, place, step) for place, view in now))

    def render(self, batch: Batch) -> Rendered:
        """Draw the active block between its layers; differentiable in the live parameters."""
        rendered = self._draw(batch.samples)
        if not self._run.active.shown:
            for sample, own in zip(batch.samples, rendered.transmittances, strict=True):
                self._run.health.see(share_of_picture(sample.in_front, own))
        return rendered

    def loss(
        self,
        batch: Batch,
        pictures: Sequence[Float[Tensor, "_h _w 3"]],
        photos: Sequence[Float[Tensor, "_h _w 3"]],
    ) -> Float[Tensor, ""]:
        """The loss of a step: photometric over the crops, the mean of the samples', plus what surfels and the
        density strategy ask for."""
        run = self._run
        losses = batch.losses(pictures, photos, run.config)
        loss = sum(losses[1:], start=losses[0]) / len(losses)
        run.health.note(
            [(s.view.index, found.detach()) for s, found in zip(batch.samples, losses, strict=True)]
        )
        if run.config.normal_consistency > 0 and run.share >= BEGINS:
            surfels = live_gaussians(run.params)
            off = normal_consistency(surfels, batch.samples, run.rasterizer)
            loss = loss + run.config.normal_consistency * off
        if run.config.density.strategy == "mcmc":
            loss = loss + run.density.regularisation(run.params, run.count())
        return loss

    def whole(self, view: int) -> Sample:
        """All that a view shows of the block in this visit."""
        run, active = self._run, self._run.active
        seen, crop = run.views_at(active.reduction)[view], active.geometry.crops[view]
        return self._sample_of(seen, crop, 0, run.state.step)

    @property
    def degree(self) -> int:
        """The degree of spherical harmonics in this step."""
        active = self._run.active
        changes = active.is_alone or self._run.config.recipe.sh_restart
        return self._run.sh_degree if changes else active.sh_degree

    def _sample(self, view: int, place: int, step: int) -> Sample:
        """What is drawn at one place of a step: all that a view shows of the block, or a part."""
        seen, active = self._run.views_at(self._run.reduction)[view], self._run.active
        whole = seen.full if active.is_all else active.geometry.crops[view]
        crop = part_to_draw(self._run.config, whole, step, place)
        sample = self._sample_of(seen, crop, place, step)
        return replace(sample, share=crop.pixels / whole.pixels)

    def _sample_of(self, view: View, crop: Crop, place: int, step: int) -> Sample:
        if self.layers and not self.layers.shows(view):
            raise RuntimeError(f"View {view.index} has moved since its layers were drawn.")
        layers, window = self.layers.around(view.index, crop) if self.layers else (None, None)
        return Sample(view, crop, layers, window, self._backgrounds.at(step, place))

    def _draw(self, samples: Sequence[Sample]) -> Rendered:
        run = self._run
        rasters = run.rasterizer.draw(
            live_gaussians(run.params),
            [sample.shot for sample in samples],
            sh_degree=self.degree,
            antialiased=run.config.antialiased,
            absgrad=run.density.absgrad,
            weigh=run.density.weighs,
        )
        if run.density.weighs:
            pairs = zip(rasters, samples, strict=True)
            rasters = tuple(weighed(raster, sample.in_front, sample.share) for raster, sample in pairs)
        infos = tuple({id(raster.info): raster.info for raster in rasters}.values())
        run.density.before_backward(infos)
        light = run.light
        lights = [None if light is None else light.of(sample.view.index) for sample in samples]
        drawn = zip(samples, rasters, lights, strict=True)
        pictures = tuple(sample.picture(raster, transform) for sample, raster, transform in drawn)
        uses = [
            Use(sample.view.index, transform, sample.weight / self.batch)
            for sample, transform in zip(samples, lights, strict=True)
            if transform is not None
        ]
        views = tuple(sample.view for sample in samples)
        return Rendered(pictures, tuple(raster.transmittance for raster in rasters), infos, uses, views)
