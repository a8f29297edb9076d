"""Training views drawn whole, beside their photos: whole scenes are judged by them."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.layers.painter import Painter, PaintSettings, default_pass
from abcd_ns.engine.layers.whole_pictures import LAYERS_BYTES, WholePictures
from abcd_ns.engine.store.scene import BlockScene
from abcd_ns.engine.train.capture.light import lit
from abcd_ns.engine.train.memory import free_bytes, needs_of
from abcd_ns.engine.train.run import TrainingRun
from abcd_ns.engine.train.step.batch import Sample, Target
from abcd_ns.engine.types import View


class Beside(NamedTuple):
    """A picture and its photo."""

    seen: Float[Tensor, "h w 3"]
    """The picture in the photo's light, not clamped."""
    photo: Float[Tensor, "h w 3"]
    counts: Float[Tensor, "h w 1"]
    """1 for the pixels that count, else 0."""


class WholeViews:
    """Draws what a run's scene looks like in its training views.

    Args:
        target: gives what a sample should show.
    """

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
        """Draws these of the views.

        Args:
            scene: the run's, or what it would be.
        """
        run, active = self._run, self._run.state.active
        together = default_pass(scene) if active is None else run.count()
        painter = Painter(
            scene,
            views,
            run.rasterizer,
            ownership=run.config.recipe.ownership,
            pass_gaussians=run.config.limits.pass_gaussians or together,
            device=run.device,
        )
        room = LAYERS_BYTES
        if run.device.type != "cpu":  # half of what a visit's have: here a view is drawn backward beside them
            largest = max(view.full.pixels for view in views)
            parts = needs_of(run.config, largest, run.blocks).parts_bytes
            room = max(room, min(parts, free_bytes(run.device) // 2) // 2)
        return WholePictures(painter, PaintSettings(run.sh_degree, run.config.antialiased), room)

    def beside(self, view: View, shown: Float[Tensor, "h w 3"]) -> Beside:
        """A picture on black beside the view's photo."""
        sample = Sample(view, view.full, None, None, shown.new_zeros(3))
        photo, counts = self._target(sample)
        light = self._run.light
        seen = shown if light is None else lit(shown, light.of(view.index).detach(), view.full, view)
        counted = torch.ones_like(seen[..., :1]) if counts is None else counts.to(seen)
        return Beside(seen, photo.to(seen), counted)
