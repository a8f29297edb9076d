"""One visit: what a block looks like to its views, and the frozen layers around it."""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from abcd_ns.engine.compositing import empty_layer
from abcd_ns.engine.painter import Loaded, Painter, PaintSettings, Parts
from abcd_ns.engine.photometric_kernel import SSIM_WINDOW
from abcd_ns.engine.rasterizer import Rasterizer, ZWindow
from abcd_ns.engine.rasterizer.projection import Splats
from abcd_ns.engine.rasterizer.tile_grid import TileGrid
from abcd_ns.engine.storage import LayerCache, LayerKey, StaleLayerError, through_codec, view_fingerprint
from abcd_ns.engine.types import Crop, Gaussians, Layer, View
from abcd_ns.engine.visibility import footprint

Side = Literal["front", "back"]
SIDES: tuple[Side, ...] = ("front", "back")
"""The two layers of a view, under the names of their fields in Parts."""
AT_HAND_BYTES = 128 << 20
"""Size of the layers that a visit keeps at hand, at most; others are read from the cache for each step."""
PARTS_BYTES = 256 << 20
"""Size of the layers held while units are folded, at most, unless those of a single view are larger."""
BYTES_PER_PIXEL = 32
"""Of a front and a back layer in float32."""
CROP_MARGIN = SSIM_WINDOW - 1
"""Pixels added to a footprint, so that every SSIM window that sees the block lies in the crop."""


@dataclass(frozen=True)
class VisitGeometry:
    """What is decided once, when a visit begins, and must be the same after a resume."""

    block: int
    crops: dict[int, Crop]
    """By view index, the pixels to train on; views that do not see the block are missing."""

    @property
    def views(self) -> tuple[int, ...]:
        """Indices of the views that see the block."""
        return tuple(sorted(self.crops))

    def to_json(self) -> dict[str, Any]:
        """As JSON; numbers survive exactly."""
        crops = {str(i): [c.x, c.y, c.width, c.height] for i, c in self.crops.items()}
        return {"block": self.block, "crops": crops}

    @staticmethod
    def from_json(data: dict[str, Any]) -> "VisitGeometry":
        """The inverse of `to_json`."""
        return VisitGeometry(data["block"], {int(i): Crop(*crop) for i, crop in data["crops"].items()})


def survey(
    gaussians: Gaussians, block: int, views: Iterable[View], rasterizer: Rasterizer, *, align: int = 16
) -> VisitGeometry:
    """Which views see the block's Gaussians, and where in the image.

    Args:
        align: crops begin and end on multiples of this, pixels (or at the image's edge).
    """
    views = tuple(views)
    extents = rasterizer.extents(gaussians, views).tolist() if views else []
    crops = {
        view.index: footprint(extent, view, margin=CROP_MARGIN, align=align)
        for view, extent in zip(views, extents, strict=True)
    }
    return VisitGeometry(block, {view: crop for view, crop in crops.items() if crop is not None})


@dataclass(frozen=True)
class Surroundings:
    """What one training view sees around the active block."""

    layers: Parts
    """F (front) and B (back), for the view's crop."""
    near: Splats | None
    """Frozen Gaussians to be sorted in with the active ones, as this view sees them."""
    window: ZWindow | None
    """Where the fragments of `near` count; None by means."""

    @property
    def nbytes(self) -> int:
        """Its size."""
        held = [image for side in SIDES for image in vars(getattr(self.layers, side)).values()]
        held += [] if self.window is None else [self.window.near, self.window.far]
        held += [] if self.near is None else [self.near.planes]
        return sum(tensor.nbytes for tensor in held)

    def part(self, whole: Crop, crop: Crop) -> "Surroundings":
        """What is seen in a part of the crop `whole` that this is of; shares memory."""
        if crop == whole:
            return self
        inside = crop.within(whole)
        layers = Parts(self.layers.front[inside], self.layers.back[inside])
        return Surroundings(layers, self.near, _part_of_window(self.window, crop))


class VisitLayers:
    """F and B for the views of one visit, drawn once and kept at hand or in the layer cache.

    Args:
        own: the block's Gaussians when the visit began; they decide the windows.
        window_weight: see TrainingConfig.
        views: all views, by index.
        scene_key: fingerprint of all else that changes a pixel, for the cache's keys.
        at_hand_bytes: see AT_HAND_BYTES.
    """

    def __init__(
        self,
        painter: Painter,
        cache: LayerCache,
        geometry: VisitGeometry,
        own: Gaussians,
        views: Mapping[int, View],
        settings: PaintSettings,
        *,
        window_weight: float,
        scene_key: str,
        at_hand_bytes: int = AT_HAND_BYTES,
    ) -> None:
        self._painter, self._cache = painter, cache
        self._geometry, self._views, self._settings = geometry, views, settings
        self._window_weight, self._scene_key = window_weight, scene_key
        self._versions = self._frozen_versions()
        self._units = painter.units(exclude=geometry.block)
        self._own = own if painter.ownership == "fragments" and self._units else None
        # All views of the block, though few may be drawn: what is loaded must not depend on which.
        self._seen_by = painter.frusta((views[view], crop) for view, crop in sorted(geometry.crops.items()))
        self._near: dict[int, Splats | None] = {}
        self._windows: dict[int, ZWindow] = {}
        self._at_hand: dict[int, Surroundings] = {}
        self._room = at_hand_bytes
        self._uses_cache = False

    def draw(self, views: Iterable[int]) -> Iterator[tuple[int, Surroundings]]:
        """Draw what is missing for these views; yields each view when it is ready."""
        missing = []
        for view in dict.fromkeys(views):
            found = self._found(view, self._geometry.crops[view])
            if found is None:
                missing.append(view)
            else:
                yield view, found
        for group in self._groups(missing):
            yield from self._draw_group(group)

    def _groups(self, views: Sequence[int]) -> Iterator[Sequence[int]]:
        """Views that are drawn together: as many as there is room for what their units are folded from."""
        if len(self._units) == 1:
            yield views
            return
        levels = max(map(self._painter.depth_of, self._units), default=0) + 1
        group: list[int] = []
        room = PARTS_BYTES
        for view in views:
            crop = self._geometry.crops[view]
            room -= levels * BYTES_PER_PIXEL * crop.pixels
            if group and room < 0:
                yield group
                group, room = [], PARTS_BYTES - levels * BYTES_PER_PIXEL * crop.pixels
            group.append(view)
        if group:
            yield group

    def _draw_group(self, views: Sequence[int]) -> Iterator[tuple[int, Surroundings]]:
        """All units one after the other, each for all of these views: the device holds one at a time."""
        self._find_windows(views)
        block = self._geometry.block
        # By means no unit holds the active block's own place in the order; nothing stands there.
        own_place = {} if self._own is not None else {self._painter.tree.node_of(block): None}
        parts: dict[int, dict[int, Parts | None]] = {view: dict(own_place) for view in views}
        for unit in self._units:
            loaded = self._painter.load(unit, exclude=block, seen_by=self._seen_by)
            for view in views:
                parts[view][unit] = self._paint(unit, loaded, view)
                self._painter.fold_up(parts[view], unit, self._views[view])
                if unit == self._units[-1]:
                    yield view, self._keep(view, parts.pop(view))

    def around(self, view: int, crop: Crop | None = None) -> Surroundings:
        """What `view` sees around the active block, in a part of the visit's crop or in all of it.

        Raises:
            StaleLayerError: a frozen block has changed since the visit began.
        """
        if self._frozen_versions() != self._versions:
            raise StaleLayerError(f"a frozen block changed during the visit of block {self._geometry.block}")
        whole = self._geometry.crops[view]
        found = self._found(view, crop or whole)
        if found is None:  # never drawn, or the disposable cache has lost it
            ((_, drawn),) = self.draw([view])
            found = drawn.part(whole, crop or whole)
        return found

    @property
    def nbytes(self) -> int:
        """Of the layers at hand."""
        return sum(around.nbytes for around in self._at_hand.values())

    def forget(self) -> None:
        """Give back the room in the cache: when the block has changed, nothing of it will be found again."""
        if self._uses_cache:
            self._cache.drop(self._prefix)

    def _found(self, view: int, crop: Crop) -> Surroundings | None:
        whole = self._geometry.crops[view]
        if view in self._at_hand:
            return self._at_hand[view].part(whole, crop)
        layers = self._cached(view, crop.within(whole))
        if layers is None:
            return None
        near = self._near.get(view)
        return Surroundings(
            layers,
            near and Splats(near.planes.to(self._painter.device)),
            _part_of_window(self._window(view), crop),
        )

    def _frozen_versions(self) -> dict[int, int]:
        scene = self._painter.scene
        return {b: scene.version(b) for b in range(scene.tree.num_blocks) if b != self._geometry.block}

    def _find_windows(self, views: Iterable[int]) -> None:
        if self._own is None:
            return
        own = self._own.to(self._painter.device)
        for view in views:
            if view not in self._windows:
                self._windows[view] = self._painter.rasterizer.depth_window(
                    own,
                    self._views[view],
                    crop=self._geometry.crops[view],
                    visible=self._window_weight,
                    antialiased=self._settings.antialiased,
                )

    def _window(self, view: int) -> ZWindow | None:
        return None if self._own is None else self._windows[view]

    def _paint(self, unit: int, loaded: Loaded, view: int) -> Parts | None:
        return self._painter.paint(
            unit,
            loaded,
            self._views[view],
            self._geometry.crops[view],
            self._settings,
            active=self._geometry.block,
            window=self._window(view),
        )

    def _keep(self, view: int, parts: dict[int, Parts | None]) -> Surroundings:
        """Fold, and put at hand or into the cache; what comes back went through the codec either way."""
        folded = self._painter.fold(parts, self._views[view], self._geometry.crops[view])
        stored = (through_codec(getattr(folded, side), self._cache.bits) for side in SIDES)
        around = Surroundings(
            Parts(*map(self._on_device, stored)), near=folded.inside, window=self._window(view)
        )
        self._near[view] = folded.inside
        if around.nbytes <= self._room:
            self._at_hand[view] = around
            self._room -= around.nbytes
        else:
            self._near[view] = folded.inside and Splats(folded.inside.planes.cpu())
            self._cache.put_many((self._key(view, side), getattr(folded, side)) for side in SIDES)
            self._uses_cache = True
        return around

    def _cached(self, view: int, part: Crop) -> Parts | None:
        if not self._units:
            matrix = self._views[view].viewmat
            nothing = empty_layer(part.height, part.width, self._painter.device, matrix.dtype)
            return Parts(nothing, nothing)
        if self._own is not None and view not in self._near:
            return None  # after a resume: what is near was never written down
        found = [self._cache.get(self._key(view, side)) for side in SIDES]
        if any(layer is None for layer in found):
            return None
        return Parts(*(self._on_device(layer[part]) for layer in found))

    def _on_device(self, layer: Layer) -> Layer:
        dtype, device = next(iter(self._views.values())).viewmat.dtype, self._painter.device
        return Layer(layer.color.to(device, dtype), layer.transmittance.to(device, dtype))

    def _key(self, view: int, side: Side) -> LayerKey:
        geometry, scene = self._geometry, self._painter.scene
        window = None if self._own is None else [scene.version(geometry.block), self._window_weight]
        cut = json.dumps([side, geometry.block, window, self._painter.ownership])
        return LayerKey(
            scene=self._scene_key,
            view=view_fingerprint(self._views[view]),
            crop=geometry.crops[view],
            content=(cut, *self._versions.items()),
            sh_degree=self._settings.sh_degree,
            raster_mode="antialiased" if self._settings.antialiased else "classic",
            rasterizer=self._painter.rasterizer.name,
            bits=self._cache.bits,
            prefix=self._prefix,
        )

    @property
    def _prefix(self) -> str:
        return f"block-{self._geometry.block}"


def _part_of_window(window: ZWindow | None, crop: Crop) -> ZWindow | None:
    """The window of a part of the crop that it is of."""
    return window and window.on(TileGrid(crop, window.grid.side))
