"""Draws the steps of a visit, alone or with helpers, and takes their loss."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.events import Announcer
from abcd_ns.engine.gaussians.param_swap import live_gaussians
from abcd_ns.engine.layers.visit_layers import VisitLayers
from abcd_ns.engine.space.influence import share_shown
from abcd_ns.engine.train.capture.light import Use
from abcd_ns.engine.train.health.health_rules import share_of_picture
from abcd_ns.engine.train.layer_source import LayerSource
from abcd_ns.engine.train.run import TrainingRun
from abcd_ns.engine.train.run_state import ActiveVisit
from abcd_ns.engine.train.schedule import (
    endless_order,
    size_of_crew,
    view_order,
    views_of_member,
    views_per_step,
    views_per_warm_up_step,
)
from abcd_ns.engine.train.step.batch import Backgrounds, Batch, Rendered, Sample, part_to_draw
from abcd_ns.engine.train.step.weighing import weighed
from abcd_ns.engine.train.step.workers.crew import Crew
from abcd_ns.engine.train.step.workers.helper_process import can_fork
from abcd_ns.engine.train.step.workers.share import Contribution, DrawShare, Share, Target, Task, share_of
from abcd_ns.engine.types import Crop, Gaussians, View


class StepDrawing:
    """The active block between its layers, for the views of each step of a visit.

    Args:
        source: gives a visit its layers.
        target: gives what a sample is trained on, so that helpers can share a step (see `crew`); None for
            one process.
    """

    def __init__(
        self, run: TrainingRun, source: LayerSource, target: Callable[[Sample], Target] | None = None
    ) -> None:
        self._run, self._source, self._target = run, source, target
        self._backgrounds = Backgrounds(run.config, run.device)
        self._order: tuple[int, ...] = ()
        self.crew: Crew | None = None
        self.layers: VisitLayers | None = None

    # -- a visit -------------------------------------------------------------------------------------

    @property
    def batch(self) -> int:
        """Views in a step of the visit that is under way."""
        config, active = self._run.config, self._run.state.active
        if active is not None and active.is_whole:
            return views_per_warm_up_step(config.batch, config.limits.batch_limit)
        return views_per_step(config.batch, self._run.scene.tree.num_blocks, config.limits.batch_limit)

    def size_of_crew(self, active: ActiveVisit) -> int:
        """Members that are to share the views of each of its steps."""
        config = self._run.config
        if self._target is None or config.recipe.overlap > 0:  # there each pixel counts in a way of its own
            return 1
        threads = torch.get_num_threads() if can_fork(self._run.device) else 1
        return size_of_crew(config.processes or threads, self.batch, len(active.views))

    def begin_visit(self, active: ActiveVisit) -> None:
        """Gather helpers and draw layers; the block is live."""
        self._order = self._order_of(active)
        self.crew = self._gather_crew(active)
        self.layers = self._source.draw(active, self._left_to_draw(active, self._order))

    def gather_anew(self) -> None:
        """Let go of helpers, and gather others, who see the run as it is now."""
        if self.crew is not None:
            self.crew.dismiss()
            self.crew = self._gather_crew(self._run.active)

    def end_visit(self) -> None:
        """Let go of helpers and layers."""
        if self.crew is not None:
            self.crew.dismiss()
        self.layers, self.crew = None, None

    def shown_in(self, views: Sequence[int]) -> dict[int, float]:
        """The influence that the block has on each of these views by now."""
        shown, live = {}, live_gaussians(self._run.params)
        for view in views:
            seen, crop = self._run.views_at(self._run.reduction)[view], self._run.active.geometry.crops[view]
            sample = self._sample_of(seen, crop, 0, self._run.state.step)
            before = sample.layers and sample.layers.front.transmittance
            antialiased = self._run.config.antialiased
            shown[view] = share_shown(
                live, self._run.rasterizer, sample.shot, before, antialiased=antialiased
            )
        return shown

    def _order_of(self, active: ActiveVisit, member: int = 0) -> tuple[int, ...]:
        """The views that a member of the crew draws in a visit, in order; none where nobody knows how many
        steps it will have, and its views are drawn in turn."""
        taken = 0 if active.is_alone else active.steps * (self.batch // active.crew)
        views = views_of_member(active.views, member, active.crew)
        return view_order(views, taken, active.number, self._run.config.seed, member)

    def _left_to_draw(self, active: ActiveVisit, order: tuple[int, ...]) -> tuple[int, ...]:
        return order[active.done * (self.batch // active.crew) :]

    def _views_of_step(
        self, active: ActiveVisit, order: tuple[int, ...], done: int, member: int = 0
    ) -> tuple[int, ...]:
        each = self.batch // active.crew
        if not order:  # nobody knows how many steps there will be
            places = range(done * self.batch + member * each, done * self.batch + (member + 1) * each)
            return tuple(endless_order(active.views, place, self._run.config.seed) for place in places)
        return order[done * each : (done + 1) * each]

    # -- a step --------------------------------------------------------------------------------------

    def next_batch(self) -> Batch:
        """What to draw next; helpers begin at once."""
        active, step = self._run.active, self._run.state.step
        if self.crew is not None:
            task = Task(active.done, step, self.degree)
            self.crew.begin(live_gaussians(self._run.params), task)
        views = enumerate(self._views_of_step(active, self._order, active.done))
        return Batch(step, tuple(self._sample(view, place, step) for place, view in views))

    def render(self, batch: Batch) -> Rendered:
        """Draw the active block between its layers; differentiable in the live parameters."""
        rendered = self._draw(live_gaussians(self._run.params), batch.samples, self.degree)
        if not self._run.active.shown:
            for sample, own in zip(batch.samples, rendered.transmittances, strict=True):
                self._run.health.see(share_of_picture(sample.layers and sample.layers.front, own))
        return rendered

    def loss(
        self,
        batch: Batch,
        pictures: Sequence[Float[Tensor, "_h _w 3"]],
        photos: Sequence[Float[Tensor, "_h _w 3"]],
    ) -> Float[Tensor, ""]:
        """The loss of a step: photometric over the crops, the mean of the samples', plus what the density
        strategy asks for. With helpers, all of them included."""
        run = self._run
        losses = batch.losses(pictures, photos, run.config)
        members = 1 if self.crew is None else run.active.crew
        photometric = sum(losses[1:], start=losses[0]) / (len(losses) * members)
        known = [(s.view.index, loss.detach()) for s, loss in zip(batch.samples, losses, strict=True)]
        if self.crew is not None:
            photometric, drawn = photometric + self.crew.loss(), self.crew.drawn()
            run.health.see(torch.tensor(max(part.shown for part in drawn), device=run.device))
            known += [(v, torch.tensor(loss, device=run.device)) for part in drawn for v, loss in part.losses]
        run.health.note(known)
        if run.config.density.strategy != "mcmc":
            return photometric
        return photometric + run.density.regularisation(run.params, run.count())

    def whole(self, view: int) -> Sample:
        """All that a view shows of the block in this visit."""
        run, active = self._run, self._run.active
        seen, crop = run.views_at(active.reduction)[view], active.geometry.crops[view]
        return self._sample_of(seen, crop, 0, run.state.step)

    def contributions(self) -> list[Contribution]:
        """What helpers add to the step."""
        return [] if self.crew is None else self.crew.contributions()

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
        around = self.layers.around(view.index, crop) if self.layers else None
        return Sample(
            view=view,
            crop=crop,
            layers=around and around.layers,
            interleaved=around and around.interleaved,
            window=around and around.window,
            background=self._backgrounds.at(step, place),
        )

    def _draw(self, gaussians: Gaussians, samples: Sequence[Sample], sh_degree: int) -> Rendered:
        run, crew = self._run, self._run.active.crew
        rasters = run.rasterizer.draw(
            gaussians,
            [sample.shot for sample in samples],
            sh_degree=sh_degree,
            antialiased=run.config.antialiased,
            absgrad=run.density.absgrad,
            weigh=run.density.weighs,
        )
        if run.density.weighs:
            pairs = zip(rasters, samples, strict=True)
            rasters = tuple(weighed(raster, sample.in_front, sample.share) for raster, sample in pairs)
        infos = tuple({id(raster.info): raster.info for raster in rasters}.values())
        if crew > 1:  # density control judges by gradients of the sum over all of a step's views
            infos = tuple({**info, "n_cameras": info["n_cameras"] * crew} for info in infos)
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
        return Rendered(pictures, tuple(raster.transmittance for raster in rasters), infos, uses)

    # -- helpers -------------------------------------------------------------------------------------

    def _gather_crew(self, active: ActiveVisit) -> Crew | None:
        if active.crew == 1:
            return None
        draws = [partial(self._begin_helping, active, member) for member in range(1, active.crew)]
        return Crew(draws, live_gaussians(self._run.params), forks=can_fork(self._run.device))

    def _begin_helping(self, active: ActiveVisit, member: int, in_own_process: bool) -> DrawShare:
        """What draws a helper's shares; in its own process, which alone this changes, with layers drawn."""
        order = self._order_of(active, member)
        if in_own_process:
            self._run.announce = Announcer()
            self.layers = self._source.draw(active, self._left_to_draw(active, order))
        return partial(self._draw_share, active, member, order)

    def _draw_share(
        self, active: ActiveVisit, member: int, order: tuple[int, ...], gaussians: Gaussians, task: Task
    ) -> Share:
        views = self._views_of_step(active, order, task.done, member)
        first = member * len(views)
        samples = [self._sample(view, first + k, task.step) for k, view in enumerate(views)]
        rendered = self._draw(gaussians, samples, task.sh_degree)
        return share_of(
            gaussians, samples, rendered, self._target, self._run.config, self._run.density, views=self.batch
        )
