"""Draws the steps of a visit, alone or with helpers, and takes their loss."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.events import Announcer
from abcd_ns.engine.gaussians.param_swap import Params, live_gaussians
from abcd_ns.engine.layers.visit_layers import VisitLayers
from abcd_ns.engine.render import Rasterizer
from abcd_ns.engine.space.influence import share_shown
from abcd_ns.engine.train.batch import Backgrounds, Batch, Rendered, Sample, part_to_draw
from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.train.density.control import DensityControl
from abcd_ns.engine.train.health.health import Health
from abcd_ns.engine.train.health.health_rules import share_of_picture
from abcd_ns.engine.train.run_state import ActiveVisit
from abcd_ns.engine.train.schedule import size_of_crew
from abcd_ns.engine.train.workers.crew import Crew
from abcd_ns.engine.train.workers.helper_process import can_fork
from abcd_ns.engine.train.workers.share import DrawShare, Share, Target, Task, share_of
from abcd_ns.engine.types import Crop, Gaussians, View


class StepDrawing(ABC):
    """What a coordinator draws: the active block between its layers, for the views of a step.

    A coordinator says which block is active, on which views, and when; it has what is declared here.
    """

    config: TrainingConfig
    views: dict[int, View]
    device: torch.device
    params: Params
    announce: Announcer
    density: DensityControl
    health: Health
    batch: int
    """Views in a step of the visit that is under way."""
    sh_degree: int
    """The degree of spherical harmonics in use."""
    _rasterizer: Rasterizer
    _backgrounds: Backgrounds
    _target: Callable[[Sample], Target] | None
    _layers: VisitLayers | None
    _crew: Crew | None

    @property
    @abstractmethod
    def _active(self) -> ActiveVisit:
        """The visit that is under way."""

    @abstractmethod
    def count(self) -> int:
        """Gaussians in the whole scene."""

    @abstractmethod
    def _order_of(self, active: ActiveVisit, member: int = 0) -> tuple[int, ...]:
        """The views that a member of the crew draws in a visit, in order; none where nobody knows how many
        steps it will have, and its views are drawn in turn."""

    @abstractmethod
    def _views_of_step(
        self, active: ActiveVisit, order: tuple[int, ...], done: int, member: int = 0
    ) -> tuple[int, ...]:
        """Those that it draws in the step after `done` others."""

    @abstractmethod
    def _draw_layers(self, active: ActiveVisit, order: tuple[int, ...]) -> VisitLayers | None:
        """F and B of these views."""

    # -- a step --------------------------------------------------------------------------------------

    def _sample(self, view: int, place: int, step: int) -> Sample:
        """What is drawn at one place of a step: all that a view shows of the block, or a part."""
        whole = self._active.geometry.crops[view]
        crop = part_to_draw(self.config, whole, step, place)
        sample = self._sample_of(view, crop, place, step)
        return replace(sample, share=crop.pixels / whole.pixels)

    def _sample_of(self, view: int, crop: Crop, place: int, step: int) -> Sample:
        around = self._layers.around(view, crop) if self._layers else None
        return Sample(
            view=self.views[view],
            crop=crop,
            layers=around and around.layers,
            near=around and around.near,
            window=around and around.window,
            background=self._backgrounds.at(step, place),
        )

    def _shown_in(self, views: Sequence[int], step: int) -> dict[int, float]:
        """The influence that the block has on each of these views by now."""
        shown, live = {}, live_gaussians(self.params)
        for view in views:
            sample = self._sample_of(view, self._active.geometry.crops[view], 0, step)
            before = sample.layers and sample.layers.front.transmittance
            shown[view] = share_shown(
                live, self._rasterizer, sample.shot, before, antialiased=self.config.antialiased
            )
        return shown

    @property
    def _degree_drawn(self) -> int:
        """The degree of spherical harmonics in this step."""
        changes = self._active.is_alone or self.config.recipe.sh_restart
        return self.sh_degree if changes else self._active.sh_degree

    def render(self, batch: Batch) -> Rendered:
        """Draw the active block between its layers; differentiable in the live parameters."""
        rendered = self._draw(live_gaussians(self.params), batch.samples, self._degree_drawn)
        if not self._active.shown:
            for sample, own in zip(batch.samples, rendered.transmittances, strict=True):
                self.health.see(share_of_picture(sample.layers and sample.layers.front, own))
        return rendered

    def _draw(self, gaussians: Gaussians, samples: Sequence[Sample], sh_degree: int) -> Rendered:
        rasters = self._rasterizer.draw(
            gaussians,
            [sample.shot for sample in samples],
            sh_degree=sh_degree,
            antialiased=self.config.antialiased,
            absgrad=self.density.absgrad,
        )
        infos = tuple({id(raster.info): raster.info for raster in rasters}.values())
        if self._active.crew > 1:  # density control judges by gradients of the sum over all of a step's views
            infos = tuple({**info, "n_cameras": info["n_cameras"] * self._active.crew} for info in infos)
        self.density.before_backward(infos)
        pictures = (sample.picture(raster) for sample, raster in zip(samples, rasters, strict=True))
        return Rendered(tuple(pictures), tuple(raster.transmittance for raster in rasters), infos)

    def loss(
        self,
        batch: Batch,
        pictures: Sequence[Float[Tensor, "_h _w 3"]],
        photos: Sequence[Float[Tensor, "_h _w 3"]],
    ) -> Float[Tensor, ""]:
        """The loss of a step: photometric over the crops, the mean of the samples', plus what the density
        strategy asks for. With helpers, all of them included."""
        triples = zip(batch.samples, pictures, photos, strict=True)
        losses = [sample.loss(picture, photo, self.config) for sample, picture, photo in triples]
        members = 1 if self._crew is None else self._active.crew
        photometric = sum(losses[1:], start=losses[0]) / (len(losses) * members)
        known = [(s.view.index, loss.detach()) for s, loss in zip(batch.samples, losses, strict=True)]
        if self._crew is not None:
            photometric, drawn = photometric + self._crew.loss(), self._crew.drawn()
            shown = max(part.shown for part in drawn)
            self.health.see(torch.tensor(shown, device=self.device))
            known += [
                (v, torch.tensor(loss, device=self.device)) for part in drawn for v, loss in part.losses
            ]
        self.health.note(known)
        if self.config.density.strategy != "mcmc":
            return photometric
        return photometric + self.density.regularisation(self.params, self.count())

    # -- helpers -------------------------------------------------------------------------------------

    def _size_of_crew(self, active: ActiveVisit) -> int:
        if self._target is None or self.config.recipe.overlap > 0:  # there pixels count in their own way
            return 1
        threads = torch.get_num_threads() if can_fork(self.device) else 1
        return size_of_crew(self.config.processes or threads, self.batch, len(active.views))

    def _gather_crew(self, active: ActiveVisit) -> Crew | None:
        if active.crew == 1:
            return None
        members = range(1, active.crew)
        draws = [partial(self._begin_helping, active, member) for member in members]
        return Crew(draws, live_gaussians(self.params), forks=can_fork(self.device))

    def _begin_helping(self, active: ActiveVisit, member: int, in_own_process: bool) -> DrawShare:
        """What draws a helper's shares; in its own process, which alone this changes, with layers drawn."""
        order = self._order_of(active, member)
        if in_own_process:
            self.announce = Announcer()
            self._layers = self._draw_layers(active, order)
        return partial(self._draw_share, active, member, order)

    def _draw_share(
        self, active: ActiveVisit, member: int, order: tuple[int, ...], gaussians: Gaussians, task: Task
    ) -> Share:
        views = self._views_of_step(active, order, task.done, member)
        first = member * len(views)
        samples = [self._sample(view, first + k, task.step) for k, view in enumerate(views)]
        rendered = self._draw(gaussians, samples, task.sh_degree)
        return share_of(
            gaussians, samples, rendered, self._target, self.config, self.density, views=self.batch
        )
