"""The pictures that the viewer asks for: the whole scene by parts, or what belongs to one block."""

import atexit
import math
import threading
import time
from dataclasses import dataclass, replace
from enum import Enum

import torch
from nerfstudio.viewer.render_state_machine import RenderStateMachine

from abcd_ns.engine.layers.compositing import over
from abcd_ns.engine.layers.layer_renderer import FrozenLayers, LayerRenderer, RenderSettings, Seen
from abcd_ns.engine.render import Raster, Shot, ZWindow
from abcd_ns.engine.render.cpu.reference import MIN_TRANSMITTANCE
from abcd_ns.engine.render.projection import Splats
from abcd_ns.engine.space.influence import coarser
from abcd_ns.engine.types import Gaussians, View

MOST_PIXELS = 2048 * 2048
"""Of a picture for the viewer, whatever size a client asks for; nerfstudio's slider ends there."""
FAR = 1e4  # depth of pictures that have none; world units
SECONDS_TO_END = 10.0  # for pictures that are being drawn when the process ends


class Show(str, Enum):
    """What the viewer shows; the values are its words."""

    EVERYTHING = "everything"
    BLOCK = "the block alone"
    FRONT = "F: all in front of it"
    BACK = "B: all behind it"
    COMPOSITE = "composite: F, block, B"


@dataclass(frozen=True)
class Choice:
    """What the user chose to see."""

    show: Show = Show.EVERYTHING
    block: int | None = None  # None follows the block in training


def asked_by_viewer() -> bool:
    """Whether this thread draws for a browser, and not for training, evaluation or export."""
    return isinstance(threading.current_thread(), RenderStateMachine)


@atexit.register
def end_drawing() -> None:
    """Wait for threads that draw for browsers: stopped in torch's C++ they would abort the process."""
    drawing = [thread for thread in threading.enumerate() if isinstance(thread, RenderStateMachine)]
    for thread in drawing:
        thread.running, thread.interrupt_render_flag = False, True
    until = time.monotonic() + SECONDS_TO_END
    for thread in drawing:
        thread.join(max(until - time.monotonic(), 0.0))


def chosen_outputs() -> tuple[str, ...]:
    """Outputs of the model that the browser of this thread shows; none in other threads."""
    if not asked_by_viewer():
        return ()
    panel = threading.current_thread().viewer.control_panel
    return (panel.output_render, *([panel.split_output_render] if panel.split else []))


def bounded(view: View) -> View:
    """The view in as many pixels as a client may ask for, and at least one."""
    times = math.ceil(math.sqrt(view.width * view.height / MOST_PIXELS))
    smaller = coarser(view, times) if times > 1 else view
    return replace(smaller, width=max(smaller.width, 1), height=max(smaller.height, 1))


@dataclass(frozen=True)
class BlockPictures:
    """Draws one view of a scene node by node, so that the device never holds more than one of them."""

    renderer: LayerRenderer
    view: View
    settings: RenderSettings
    window_weight: float = 0.0  # see Recipe: F and B are cut as training cuts them

    @torch.no_grad()
    def draw(self, show: Show, block: int | None) -> Raster:
        """What was chosen; everything if no block is given. F, B and the composite have no depth: they lie
        far behind whatever the browser draws over them."""
        if show is Show.EVERYTHING or block is None:
            return self.renderer.picture(self.view, self.settings, MIN_TRANSMITTANCE)
        own = self.renderer.scene.drawn(block, self.renderer.device)
        if show is Show.BLOCK:
            return self._raster(own)
        window = None
        if self.renderer.ownership == "fragments":
            options = {"visible": self.window_weight, "antialiased": self.settings.antialiased}
            shots = [Shot(self.view, self.view.full)]
            (window,) = self.renderer.rasterizer.depth_windows(own, shots, **options)
        around = self._around(block, window)
        layer = around.front if show is Show.FRONT else around.back
        if show is Show.COMPOSITE:
            active = self._raster(own, around.inside, window if around.inside is not None else None)
            layer = over(around.front, over(active.layer, around.back))
        return Raster(layer.color, layer.transmittance, FAR * (1 - layer.transmittance), {})

    def _raster(
        self, gaussians: Gaussians, frozen: Splats | None = None, window: ZWindow | None = None
    ) -> Raster:
        if len(gaussians) == 0 and frozen is None:
            return self.renderer.nothing(self.view)
        shot = Shot(self.view, self.view.full, frozen, window)
        return self.renderer.rasterizer.draw(gaussians, [shot], **vars(self.settings))[0]

    def _around(self, block: int, window: ZWindow | None) -> FrozenLayers:
        renderer, view = self.renderer, self.view
        seen, parts = Seen(view, view.full, window), dict[int, FrozenLayers | None]()
        nodes = renderer.nodes(exclude=block)
        for node, shown in renderer.shown(nodes, [(view, view.full)], exclude=block).items():
            (parts[node],) = renderer.render(node, renderer.load(shown), [seen], self.settings, block)
            renderer.fold_up(parts, node, seen)
        return renderer.fold(parts, view, view.full)
