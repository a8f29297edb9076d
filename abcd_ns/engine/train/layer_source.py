"""Where a visit's layers come from: the frozen blocks, drawn around the one that is to be trained."""

from collections.abc import Iterable
from dataclasses import dataclass

from abcd_ns.engine.events import LayersDrawn
from abcd_ns.engine.layers.layer_renderer import PARTS_BYTES, LayerRenderer, RenderSettings, default_pass
from abcd_ns.engine.layers.layer_store import LAYER_BYTES, LayerStore
from abcd_ns.engine.layers.visit_layers import VisitLayers
from abcd_ns.engine.store.scene import BlockScene
from abcd_ns.engine.train.memory import free_bytes, needs_of
from abcd_ns.engine.train.run import TrainingRun
from abcd_ns.engine.train.run_state import ActiveVisit
from abcd_ns.engine.types import View


@dataclass(frozen=True)
class LayerRoom:
    """Bytes that a visit may keep of layers."""

    device: int = LAYER_BYTES
    ram: int = 0
    """For those that have no room on the device; see LayerStore."""

    def parted(self, share: float) -> tuple["LayerRoom", "LayerRoom"]:
        """A share of it, and the rest."""
        first = LayerRoom(int(share * self.device), int(share * self.ram))
        return first, LayerRoom(self.device - first.device, self.ram - first.ram)


def layers_of_visit(
    run: TrainingRun, room: LayerRoom, active: ActiveVisit, views: Iterable[int]
) -> VisitLayers | None:
    """F and B of these views, or None where nothing is around the block; listeners hear of each."""
    config = run.config
    if active.is_alone or run.scene.tree.num_blocks == 1 or not config.recipe.layers:
        return None
    layers = VisitLayers(
        renderer_of(run, run.scene),
        LayerStore(run.device, room.device, room.ram),
        active.geometry,
        run.scene.stored_with_pending(active.geometry.block),
        run.views,
        RenderSettings(active.sh_degree, config.antialiased),
        active.visible,
        window_weight=config.recipe.window_weight,
        parts_bytes=parts_bytes(run, run.views.values(), blocks=2),
        backwards=active.number % 2 == 1,
    )
    wanted = tuple(dict.fromkeys(views))
    ready = 0

    def tell() -> None:
        run.announce(LayersDrawn(active.number, ready, len(wanted)))

    for ready, _ in enumerate(layers.draw(wanted, tell), start=1):  # noqa: B007
        tell()
    return layers


def renderer_of(run: TrainingRun, scene: BlockScene) -> LayerRenderer:
    """What draws a scene, the run's or what it would be, as the run's options have it."""
    return LayerRenderer(
        scene,
        run.rasterizer,
        ownership=run.config.recipe.ownership,
        pass_gaussians=run.config.limits.pass_gaussians or default_pass(scene),
        device=run.device,
    )


def parts_bytes(run: TrainingRun, views: Iterable[View], blocks: int, share: float = 1.0) -> int:
    """Size of the layers that may be held while nodes are folded, where steps train by one block or several;
    of an accelerator a share of what it has for them."""
    if run.device.type == "cpu":  # where a block is loaded from RAM to RAM
        return PARTS_BYTES
    needs = needs_of(run.config, max(view.full.pixels for view in views), blocks)
    return max(PARTS_BYTES, int(share * min(needs.parts_bytes, free_bytes(run.device) // 2)))
