"""What a step's pictures lack, summed up for each Gaussian by the backward pass: growth judges by it."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from abcd_ns.engine.train.density.worth import Judged
from abcd_ns.engine.train.step.batch import Pictures, Rendered, Sample


class Residuals:
    """Those of the step that is under way."""

    def __init__(self) -> None:
        self._asked: list[tuple[dict[str, Any], int, Sample, Tensor]] = []

    @torch.no_grad()
    def ask(
        self, rendered: Rendered, samples: Sequence[Sample], pictures: Pictures, photos: Pictures
    ) -> None:
        """Before the backward pass.

        Args:
            rendered: of these samples.
            pictures: what is compared with the photos.
        """
        compared = list(zip(samples, pictures, photos, strict=True))
        for info in (info for info in rendered.infos if "sums" in info):
            own = [
                each for raster, each in zip(rendered.rasters, compared, strict=True) if raster.info is info
            ]
            info["sums"].ask([sample.residual(picture, photo) for sample, picture, photo in own])
            for k, (sample, picture, photo) in enumerate(own):
                error = (photo[..., :3] - picture).square().sum(dim=-1).mean()
                self._asked.append((info, k, sample, error))

    def found(self) -> list[Judged]:
        """After it; then there are none. Nor are there any of a block of nobody."""
        asked, self._asked = self._asked, []
        known = ((info["sums"].values, *rest) for info, *rest in asked)
        return [Judged(s.view, sums[k], error, s.share) for sums, k, s, error in known if sums is not None]
