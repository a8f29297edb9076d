"""What draws a run's scene: the layers of a visit, and whole training views beside their photos."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.events import LayersDrawn
from abcd_ns.engine.layers.layer_renderer import PARTS_BYTES, LayerRenderer, RenderSettings, default_pass
from abcd_ns.engine.layers.layer_store import LAYER_BYTES, LayerStore
from abcd_ns.engine.layers.visit_layers import VisitLayers
from abcd_ns.engine.layers.whole_pictures import WholePictures
from abcd_ns.engine.space.influence import DIGITS, Influence, small_views
from abcd_ns.engine.store.scene import BlockScene
from abcd_ns.engine.train.capture.light import lit
from abcd_ns.engine.train.memory import free_bytes, needs_of
from abcd_ns.engine.train.run import TrainingRun
from abcd_ns.engine.train.run_state import ActiveVisit
from abcd_ns.engine.train.step.batch import Sample, Target
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
    recipe = run.config.recipe
    if active.is_alone or run.scene.tree.num_blocks == 1 or not recipe.layers:
        return None
    layers = VisitLayers(
        renderer_of(run, run.scene),
        LayerStore(run.device, room.device, room.ram),
        active.geometry,
        run.scene.stored_with_pending(active.geometry.block),
        run.views,
        RenderSettings(active.sh_degree, run.config.antialiased),
        active.visible,
        window_weight=recipe.window_weight,
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


@torch.no_grad()
def influence_by_layers(run: TrainingRun, scene: BlockScene) -> Influence:
    """The influence of every block of a scene on the training views; the device holds a block at a time."""
    options = {"ownership": "fragments", "pass_gaussians": 0, "device": run.device}
    renderer = LayerRenderer(scene, run.rasterizer, **options)
    settings, found = RenderSettings(0, run.config.antialiased), dict[int, dict[int, float]]()
    for view in small_views(run.views.values()):
        before: Tensor | float = 1.0
        for node, gaussians in renderer.loaded_in_order(view):
            behind = before * renderer.raster(node, gaussians, view, settings).transmittance
            block, share = scene.tree.rows[node][-1], float((before - behind).sum()) / view.full.pixels
            if block >= 0 and (share := round(share, DIGITS)):
                found.setdefault(block, {})[view.index] = share
            before = behind
    return found


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
        """A picture in its photo's light, not clamped; the photo, on `behind`, None for black; 1 where pixels
        count, else 0."""
        sample = Sample(view, view.full, None, None, shown.new_zeros(3) if behind is None else behind)
        photo, counts = self._target(sample)
        light = self._run.light
        seen = shown if light is None else lit(shown, light.of(view.index).detach())
        counted = torch.ones_like(seen[..., :1]) if counts is None else counts.to(seen)
        return seen, photo.to(seen), counted


def renderer_of(run: TrainingRun, scene: BlockScene) -> LayerRenderer:
    """What draws a scene, the run's or another, by the run's options."""
    return LayerRenderer(
        scene,
        run.rasterizer,
        ownership=run.config.recipe.ownership,
        pass_gaussians=run.config.limits.pass_gaussians or default_pass(scene),
        device=run.device,
    )


def parts_bytes(run: TrainingRun, views: Iterable[View], blocks: int, share: float = 1.0) -> int:
    """Size of the layers that may be held while nodes are folded; a share of the room of an accelerator."""
    if run.device.type == "cpu":  # where a block is loaded from RAM to RAM
        return PARTS_BYTES
    needs = needs_of(run.config, max(view.full.pixels for view in views), blocks)
    return max(PARTS_BYTES, int(share * min(needs.parts_bytes, free_bytes(run.device) // 2)))
