"""The frozen layers around a block, for the views of one visit."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from operator import add

from torch import Tensor

from abcd_ns.engine.layers.footprints import VisitGeometry
from abcd_ns.engine.layers.layer_renderer import (
    BYTES_PER_PIXEL,
    FrozenLayers,
    LayerRenderer,
    RenderSettings,
    Seen,
    Visible,
)
from abcd_ns.engine.layers.layer_store import Kept, LayerStore, packed, rounded, unpacked
from abcd_ns.engine.render import Shot, ZWindow
from abcd_ns.engine.render.z_window import TileGrid
from abcd_ns.engine.types import Crop, Gaussians, View


class VisitLayers:
    """F and B for the views of one visit. They show the frozen blocks as they were when it began.

    Args:
        store: where they are kept; new for each visit.
        own: the block's Gaussians when the visit began; they decide the windows, with Recipe.window_weight.
        parts_bytes: size of the layers held while nodes are folded, beside what is free in the store.
        backwards: load nodes in the opposite order. Where visits alternate, what the one before read last is
            still in RAM.
    """

    def __init__(
        self,
        renderer: LayerRenderer,
        store: LayerStore,
        geometry: VisitGeometry,
        own: Gaussians,
        views: Mapping[int, View],
        settings: RenderSettings,
        visible: Visible,
        *,
        window_weight: float,
        parts_bytes: int,
        backwards: bool = False,
    ) -> None:
        self._renderer, self._store = renderer, store
        # A copy: whatever becomes of the views, these are drawn.
        self._geometry, self._views, self._settings = geometry, dict(views), settings
        self._window_weight, self._parts_bytes = window_weight, parts_bytes
        self._nodes = renderer.nodes(exclude=geometry.block)[:: -1 if backwards else 1]
        self._own = own if renderer.ownership == "fragments" else None
        # All views of the block, though few may be drawn: what is loaded must not depend on which.
        seen = [(views[view], crop) for view, crop in sorted(geometry.crops.items())]
        self._shown = renderer.shown(self._nodes, seen, geometry.block, visible)
        self._windows: dict[int, ZWindow] = {}
        self._sum: Tensor | float = 0.0

    def draw(self, views: Sequence[int], alive: Callable[[], None] = lambda: None) -> Iterator[Kept]:
        """Draw F and B of these views and keep what there is room for; yields each when it is ready. `alive`
        is called for each picture of a node, of which many come before the first view is ready.

        Raises:
            RuntimeError: when all are drawn, if some pixel is NaN or infinite.
        """
        for group in self._groups(views):
            yield from self._draw_group(group, alive)
        if not math.isfinite(self._sum):  # the one look at values: a device would be waited for at each
            block = self._geometry.block
            raise RuntimeError(
                f"The layers around block {block} have NaN or infinite pixels; another block has diverged."
            )

    def _groups(self, views: Sequence[int]) -> Iterator[list[int]]:
        """Views that are drawn together: as many as there is room for what their nodes are folded from, which
        may be where those are kept that are not drawn yet."""
        group, held = list[int](), [0] * len(self._nodes)
        for view in views:
            own = list(self._held(view))
            together = list(map(add, held, own))
            if group and max(together) * BYTES_PER_PIXEL > self._parts_bytes + self._store.free:
                yield group
                self._nodes = self._nodes[::-1]
                group, together = [], list(self._held(view))
            group.append(view)
            held = together
        if group:
            yield group

    def _held(self, view: int) -> Iterator[int]:
        """Pixels of the layers that are held of a view, after each node."""
        parts: dict[int, Crop | None] = {}
        seen = self._seen(view)
        for node in self._nodes:
            parts[node] = self._shown[node].crops.get(view)
            self._renderer.fold_up(parts, node, seen, Crop.joined)
            yield sum(crop.pixels for crop in parts.values() if crop is not None)

    def _seen(self, view: int) -> Seen:
        return Seen(self._views[view], self._geometry.crops[view], self._windows.get(view))

    def _draw_group(self, views: Sequence[int], alive: Callable[[], None]) -> Iterator[Kept]:
        """All nodes one after the other, each for all of these views: the device holds one at a time."""
        self._find_windows(views)
        seen = [self._seen(view) for view in views]
        parts: dict[int, dict[int, FrozenLayers | None]] = {view: {} for view in views}
        for node in self._nodes:
            for one, part in zip(seen, self._draw_node(node, seen), strict=True):
                alive()
                view = one.view.index
                parts[view][node] = part
                self._renderer.fold_up(parts[view], node, one)
                if node == self._nodes[-1]:
                    yield self._keep(view, parts.pop(view))

    def _draw_node(self, node: int, seen: Sequence[Seen]) -> Iterator[FrozenLayers | None]:
        shown = self._shown[node]
        if not any(one.view.index in shown.crops for one in seen):
            return iter([None] * len(seen))
        loaded = self._renderer.load(shown)
        return self._renderer.render(node, loaded, seen, self._settings, self._geometry.block)

    def shows(self, view: View) -> bool:
        """Whether this very view is drawn, from where it was when the visit began."""
        return self._views[view.index].viewmat is view.viewmat

    def around(self, view: int, crop: Crop | None = None) -> tuple[FrozenLayers, ZWindow | None]:
        """What `view` sees around the active block, in a part of the visit's crop or in all of it: F, B and
        what is to be sorted in; and the window in which fragments of that count, None by means."""
        whole = self._geometry.crops[view]
        kept = self._store.get(view)
        if kept is None:  # there was no room for it, or nobody knew that it would be asked for
            (kept,) = self.draw([view])
        part = crop or whole
        layers = kept.layers[(slice(None), *part.within(whole).slices)]
        if layers.device.type == "cpu":  # elsewhere what reads them does so
            layers = layers.to(self._views[view].viewmat.dtype)
        layers, window = unpacked(layers), self._windows.get(view)  # None by means
        window = window and window.on(TileGrid(part, window.grid.side))
        return replace(layers, inside=kept.interleaved), window

    @property
    def nbytes(self) -> int:
        """Of the layers that are kept."""
        return self._store.nbytes

    def _find_windows(self, views: Iterable[int]) -> None:
        if self._own is None:
            return
        new = [view for view in views if view not in self._windows]
        shots = [Shot(self._views[view], self._geometry.crops[view]) for view in new]
        own, options = self._own.to(self._renderer.device), {"antialiased": self._settings.antialiased}
        found = self._renderer.rasterizer.depth_windows(own, shots, visible=self._window_weight, **options)
        self._windows.update(zip(new, found, strict=True))

    def _keep(self, view: int, parts: dict[int, FrozenLayers | None]) -> Kept:
        folded = self._renderer.fold(parts, self._views[view], self._geometry.crops[view])
        layers = packed(folded)
        self._sum = self._sum + layers.sum()
        kept = Kept(rounded(layers), folded.inside)
        self._store.put(view, kept)
        return kept
