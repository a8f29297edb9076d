"""What renders a trained scene, and the views that it was trained on."""

import torch

from abcd_ns.cli.export.shown import check_trained
from abcd_ns.engine.layers.layer_renderer import LayerRenderer, RenderSettings, default_pass
from abcd_ns.engine.render import make_rasterizer
from abcd_ns.engine.space.tree import BlockTree
from abcd_ns.engine.store import ParameterStore
from abcd_ns.engine.store.scene import StoredScene
from abcd_ns.engine.train.memory import drawing_bytes, free_bytes
from abcd_ns.engine.types import View
from abcd_ns.errors import UserError
from abcd_ns.nerfstudio.options import mirror
from abcd_ns.nerfstudio.pipeline import AbcdPipelineConfig
from abcd_ns.nerfstudio.views import training_views
from abcd_ns.run.fit import FREE_SHARE, RamShares
from abcd_ns.run.store import MadeFor


def open_views(
    store: ParameterStore, config: AbcdPipelineConfig
) -> tuple[LayerRenderer, RenderSettings, list[View]]:
    """What renders the scene, and its training views, as posed in the data."""
    check_trained(store)
    mirror(config.training, config.model)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    capture = config.datamanager.setup(device=device, test_mode="test").train_dataset
    views = training_views(capture.cameras, capture.metadata.get("points3D_xyz"), config.near_plane)
    if different := MadeFor.of(capture.image_filenames, views, config.training).differences(store):
        raise UserError(f"--data {config.datamanager.data} is not what the run was made for: {different}.")
    ram = RamShares.of(config.ram_budget_gb)
    scene = StoredScene(BlockTree.from_json(store.header["tree"]), store, ram.blocks)
    of_each = drawing_bytes(config.training.sh_degree, config.training.primitive)
    room = int(FREE_SHARE * free_bytes(device)) // of_each
    renderer = LayerRenderer(
        scene,
        make_rasterizer(config.model.rasterizer, device, primitive=config.training.primitive),
        ownership="fragments",
        pass_gaussians=min(default_pass(scene), room),
        device=device,
    )
    return renderer, RenderSettings(config.training.sh_degree, config.training.antialiased), views
