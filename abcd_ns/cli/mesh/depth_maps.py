"""What each training view sees of a scene, depth and colour, drawn once and kept on disk."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.layers.whole_pictures import WholePictures
from abcd_ns.engine.types import View

LEAST_OPACITY = 0.5
"""Of a pixel whose depth counts."""
SAMPLES = 1000
"""Pixels of a view by which footprints are known."""


@dataclass
class DepthMaps:
    """Of some views, in files of `folder`: 7 bytes a pixel."""

    folder: Path
    views: list[View] = field(default_factory=list)

    def draw(
        self,
        pictures: WholePictures,
        views: Sequence[View],
        advance: Callable[[], None],
        median: Callable[[View], Float[Tensor, "h w"]] | None = None,
    ) -> None:
        """Draw and keep what the views see, as many at a time as there is room for.

        Kept are camera z, world units, 0 where a view shows too little; and colours.

        Args:
            median: draws a view's median depth, to be taken in the expected one's place.
        """
        for view, picture in zip(views, pictures.draw(views), strict=True):
            number, opacity = len(self.views), 1 - picture.transmittance
            depth = median(view) if median else picture.depth / opacity.clamp_min(1e-6)
            depth = torch.where(opacity >= LEAST_OPACITY, depth, 0.0)
            color = (picture.color / opacity.clamp_min(LEAST_OPACITY)[..., None]).clamp(0, 1)
            np.save(self._file("depth", number), depth.float().cpu().numpy())
            np.save(self._file("color", number), (color * 255).round().to(torch.uint8).cpu().numpy())
            self.views.append(view)
            advance()

    def depth(self, number: int) -> np.ndarray:
        """float32 [h, w] of the view at this place of `views`."""
        return np.load(self._file("depth", number))

    def color(self, number: int) -> np.ndarray:
        """uint8 [h, w, 3]."""
        return np.load(self._file("color", number))

    def footprints(self) -> np.ndarray:
        """How wide a pixel is where it meets the surface, world units, of a sample of all pixels."""
        found = [np.zeros(0, np.float32)]
        for number, view in enumerate(self.views):
            depth = self.depth(number).ravel()
            depth = depth[:: -(-len(depth) // SAMPLES)]
            found.append(depth[depth > 0] / float(view.K[0, 0]))
        return np.concatenate(found)

    def _file(self, what: str, number: int) -> Path:
        return self.folder / f"{what}-{number:06d}.npy"
