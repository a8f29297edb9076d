"""Training views drawn whole, beside their photos: whole scenes are judged by them."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.layers.layer_renderer import RenderSettings
from abcd_ns.engine.layers.whole_pictures import WholePictures
from abcd_ns.engine.store.scene import BlockScene
from abcd_ns.engine.train.capture.light import lit
from abcd_ns.engine.train.layer_source import parts_bytes, renderer_of
from abcd_ns.engine.train.run import TrainingRun
from abcd_ns.engine.train.step.batch import Sample, Target
from abcd_ns.engine.types import View


class WholeViews:
    """Draws a run's scene in its training views, beside what `target` says that they should show."""

    def __init__(self, run: TrainingRun, target: Callable[[Sample], Target]) -> None:
        self._run, self._target = run, target

    def views(self) -> list[View]:
        """All of them, with pictures as the run has them by now, and none larger than a step may draw."""
        run, reduction = self._run, self._run.reduction
        most = run.config.limits.crop_pixels
        while most and max(view.full.pixels for view in run.views_at(reduction).values()) > most:
            reduction *= 2
        return list(run.views_at(reduction).values())

    def pictures(self, views: list[View], scene: BlockScene) -> WholePictures:
        """Draws these views of a scene: the run's, or what it would be."""
        run = self._run
        # Half of what a visit's have: here a view is drawn backward beside them.
        room = parts_bytes(run, views, run.blocks, share=0.5)
        renderer = renderer_of(run, scene)
        return WholePictures(renderer, RenderSettings(run.sh_degree, run.config.antialiased), room)

    def beside(
        self, view: View, shown: Float[Tensor, "h w 3"], behind: Float[Tensor, "3"] | None = None
    ) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w 3"], Float[Tensor, "h w 1"]]:
        """A picture on `behind`, None for black, in its photo's light, not clamped; the photo; 1 where pixels
        count, else 0."""
        sample = Sample(view, view.full, None, None, shown.new_zeros(3) if behind is None else behind)
        photo, counts = self._target(sample)
        light = self._run.light
        seen = shown if light is None else lit(shown, light.of(view.index).detach())
        counted = torch.ones_like(seen[..., :1]) if counts is None else counts.to(seen)
        return seen, photo.to(seen), counted
