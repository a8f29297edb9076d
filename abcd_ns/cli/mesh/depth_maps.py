"""What each training view sees of a scene, depth and colour, drawn once and kept on disk."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from abcd_ns.engine.layers.layer_renderer import LayerRenderer, RenderSettings
from abcd_ns.engine.layers.surface import median_depth
from abcd_ns.engine.layers.whole_pictures import WholePictures
from abcd_ns.engine.types import View
from abcd_ns.progress_bar import tracked

LEAST_OPACITY = 0.5  # of a pixel whose depth counts
SAMPLES = 1000  # pixels of a view by which footprints are known


class DepthMaps:
    """What some views see, in files of `folder`: 7 bytes a pixel. As many are drawn at once as have room.
    Depths are median ones, or else expected ones."""

    def __init__(
        self,
        folder: Path,
        renderer: LayerRenderer,
        settings: RenderSettings,
        views: Sequence[View],
        median: bool = False,
    ) -> None:
        self.views, self._folder = views, folder
        seen = zip(views, WholePictures(renderer, settings).draw(views), strict=True)
        for number, (view, picture) in enumerate(tracked(seen, "drawing", len(views))):
            opacity = 1 - picture.transmittance
            expected = picture.depth / opacity.clamp_min(1e-6)
            depth = median_depth(renderer, view, settings) if median else expected
            depth = torch.where(opacity >= LEAST_OPACITY, depth, 0.0)
            color = (picture.color / opacity.clamp_min(LEAST_OPACITY)[..., None]).clamp(0, 1)
            np.save(self._file("depth", number), depth.float().cpu().numpy())
            np.save(self._file("color", number), (color * 255).round().to(torch.uint8).cpu().numpy())

    def depth(self, number: int) -> np.ndarray:
        """Camera z, world units, float32 [h, w], of the view at this place of `views`; 0 where it shows too
        little."""
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
        return self._folder / f"{what}-{number:06d}.npy"
