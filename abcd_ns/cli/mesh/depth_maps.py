"""What each training view sees of a trained scene, depth and colour, drawn once and kept on disk."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from abcd_ns.engine.layers.layer_renderer import LayerRenderer, RenderSettings, default_pass
from abcd_ns.engine.layers.surface import median_depth
from abcd_ns.engine.layers.whole_pictures import WholePictures
from abcd_ns.engine.render import make_rasterizer
from abcd_ns.engine.space.tree import BlockTree
from abcd_ns.engine.store import ParameterStore
from abcd_ns.engine.store.scene import StoredScene
from abcd_ns.engine.train.memory import free_bytes, frozen_bytes
from abcd_ns.engine.types import View
from abcd_ns.errors import UserError
from abcd_ns.nerfstudio.options import mirror
from abcd_ns.nerfstudio.pipeline import AbcdPipelineConfig
from abcd_ns.nerfstudio.views import training_views
from abcd_ns.progress_bar import tracked
from abcd_ns.run.fit import FREE_SHARE, RamShares
from abcd_ns.run.store import MadeFor

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
        """Camera z, world units, float32 [h, w], of a view by its place; 0 where it shows too little."""
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


def open_views(
    store: ParameterStore, config: AbcdPipelineConfig
) -> tuple[LayerRenderer, RenderSettings, list[View]]:
    """What renders the scene, and its training views, as posed in the data."""
    mirror(config.training, config.model)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    capture = config.datamanager.setup(device=device, test_mode="test").train_dataset
    views = training_views(capture.cameras, capture.metadata.get("points3D_xyz"), config.near_plane)
    if different := MadeFor.of(capture.image_filenames, views, config.training).differences(store):
        raise UserError(f"--data {config.datamanager.data} is not what the run was made for: {different}.")
    ram = RamShares.of(config.ram_budget_gb)
    scene = StoredScene(BlockTree.from_json(store.header["tree"]), store, ram.blocks)
    of_each = frozen_bytes(config.training.sh_degree, config.training.primitive)
    room = int(FREE_SHARE * free_bytes(device)) // of_each
    renderer = LayerRenderer(
        scene,
        make_rasterizer(config.model.rasterizer, device, primitive=config.training.primitive),
        ownership="fragments",
        pass_gaussians=min(default_pass(scene), room),
        device=device,
    )
    return renderer, RenderSettings(config.training.sh_degree, config.training.antialiased), views
