"""Draws frozen blocks into layers, as many blocks in one pass as the device has room for.

With ownership by *fragments* (docs/design.md) a layer holds the fragments of one convex node of the
block tree, drawn from all Gaussians that reach into it, so that folding layers gives the merged picture.
With ownership by *means* a layer holds a node's own Gaussians whole, as the paper has it.
"""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from types import MappingProxyType
from typing import Any, Literal

import torch
from cachetools import LRUCache, cached

from abcd_ns.engine.layers.compositing import empty_layer, over
from abcd_ns.engine.render import CutShot, Raster, Rasterizer, Shot, ZWindow
from abcd_ns.engine.render.projection import Splats
from abcd_ns.engine.space.intervals import Rays, ray_interval, ray_intervals
from abcd_ns.engine.space.tree import BlockTree, Box, node_children_in_order, nodes_in_order
from abcd_ns.engine.space.visibility import Frusta, Optics, shared
from abcd_ns.engine.store.scene import BlockScene
from abcd_ns.engine.types import Crop, Gaussians, Layer, View

Ownership = Literal["fragments", "means"]
Visible = Mapping[int, Collection[int]]
"""By view, the blocks that are drawn for it; views that are missing have all."""
PARTS_BYTES = 256 << 20
"""Size of the layers held while nodes are folded, at most, unless those of a single view are larger, or there
is more room for them. Each group of views that has room loads the nodes that it sees once."""
BYTES_PER_PIXEL = 32
"""Of a front and a back layer in float32, or of one with its depth."""
STRADDLERS_BYTES = 256 << 20
"""Of Gaussians that reach from their blocks into others, kept while these are loaded."""
LEAST_PASS = 200_000
"""Gaussians: so many are drawn in one pass wherever blocks are small."""


@dataclass(frozen=True)
class RenderSettings:
    """What every drawing of a run has in common, under rasterizers' names for it."""

    sh_degree: int
    antialiased: bool = False


@dataclass(frozen=True)
class FrozenLayers:
    """What one view sees of a node, cut by the active block's window."""

    front: Layer
    back: Layer
    inside: Splats | None = None
    """The node's own Gaussians that have fragments in the window, if there are any; None by means."""
    crop: Crop | None = None
    """The pixels of the layers, which are empty elsewhere; None where these are known."""


@dataclass(frozen=True)
class Seen:
    """Whose picture is drawn."""

    view: View
    crop: Crop
    window: ZWindow | None = None
    """Of the active block, by fragments: what lies in it is drawn neither in front nor behind."""

    @cached_property
    def center(self) -> list[float]:
        """Of the camera, world space."""
        return self.view.center.double().tolist()

    @cached_property
    def rays(self) -> Rays:
        """Through the window's tiles."""
        return Rays.of(self.view, self.window.grid, self.window.near.device)


@dataclass(frozen=True)
class Shown:
    """What some crops may show of a node, by bounds alone: what they do not is neither read nor drawn."""

    own: list[int]
    """Of its blocks, in the tree's order."""
    others: list[int]
    """By fragments, of the blocks elsewhere that may reach into it."""
    crops: dict[int, Crop]
    """The part of each crop that may show something, by the view's index."""
    straddlers: Callable[[int], Gaussians]
    """Of another block, the Gaussians that some view may see inside the node; on the CPU."""


@dataclass(frozen=True)
class Loaded:
    """A node's Gaussians on the device."""

    gaussians: Gaussians
    """Its own, then those of other nodes that reach into it."""
    own: int
    """How many are its own."""
    crops: dict[int, Crop]
    """See Shown."""

    def shows_in(self, view: View) -> bool:
        """Whether `view` may see something of the node; False is certain."""
        return len(self.gaussians) > 0 and view.index in self.crops


class LayerRenderer:
    """Draws the frozen blocks of a scene, at most `pass_gaussians` at once on the device: a node of the tree
    that holds more is drawn in parts, down to single blocks."""

    def __init__(
        self,
        scene: BlockScene,
        rasterizer: Rasterizer,
        *,
        ownership: Ownership,
        pass_gaussians: int,
        device: torch.device | str = "cpu",
    ) -> None:
        self.scene = scene
        self.rasterizer = rasterizer
        self.ownership = ownership
        self.device = torch.device(device)
        self._pass_gaussians = pass_gaussians

    @property
    def tree(self) -> BlockTree:
        return self.scene.tree

    def nodes(self, exclude: int | None = None) -> tuple[int, ...]:
        """Nodes of the tree that tile space and hold every block but `exclude`, each to be drawn in one pass.

        Where no other node holds the cell of `exclude` it is one of them: by fragments for what reaches into
        it, by means for its place in the order.
        """
        return tuple(self._descend(0, exclude))

    def shown(
        self,
        nodes: Iterable[int],
        seen: Sequence[tuple[View, Crop]],
        exclude: int | None = None,
        visible: Visible = MappingProxyType({}),
    ) -> dict[int, Shown]:
        """What these crops may show of each node, by the bounds of visible blocks; nothing of `exclude`."""
        slack, is_by_means = self.rasterizer.slack, self.ownership == "means"
        frusta, optics = Frusta(seen, slack), Optics([view for view, _ in seen], slack)
        bounds = {b: self.scene.bounds(b) for b in range(self.tree.num_blocks) if b != exclude}
        bounds = {block: box for block, box in bounds.items() if box is not None}
        blocks, boxes = torch.tensor(list(bounds)), optics.drawn_within(list(bounds.values()))
        wanted = torch.ones(len(blocks), len(seen), dtype=torch.bool)
        for column, (view, _) in enumerate(seen):
            if view.index in visible:
                wanted[:, column] = torch.isin(blocks, torch.tensor(visible[view.index]))
        cache = LRUCache(STRADDLERS_BYTES, getsizeof=lambda gaussians: gaussians.nbytes)
        straddlers, found = cached(cache)(partial(self._straddlers, optics)), {}
        for node in nodes:
            leaves, space = self.tree.leaves(node), self.tree.box(node)
            meets, parts = shared(boxes, space)
            if is_by_means:
                meets, parts = torch.isin(blocks, torch.tensor(leaves)), boxes
            shows, crops = frusta.crops(parts[meets], wanted[meets])
            some = blocks[meets][shows.any(dim=1)].tolist()
            own = [block for block in leaves if block in some]
            if is_by_means:
                crops = {view.index: crop for view, crop in seen if view.index in crops}
            others = [block for block in some if block not in own]
            found[node] = Shown(own, others, crops, partial(self._reach_in, space, optics, straddlers))
        return found

    def load(self, shown: Shown) -> Loaded:
        """On the device: what may show of a node's blocks and, by fragments, of all others that reach in."""
        parts = [self.scene.drawn(block, self.device) for block in shown.own]
        own = sum(map(len, parts))
        parts += [shown.straddlers(block).to(self.device) for block in shown.others]
        gaussians = Gaussians.cat(parts) if parts else Gaussians.empty(device=self.device)
        return Loaded(gaussians, own, shown.crops)

    def _straddlers(self, optics: Optics, block: int) -> Gaussians:
        """A block's Gaussians that some view may see outside its cell."""
        return self.scene.drawn(block, "cpu", partial(optics.straddles, box=self.tree.cell(block)))

    @staticmethod
    def _reach_in(box: Box, optics: Optics, straddlers: Callable[[int], Gaussians], block: int) -> Gaussians:
        found = straddlers(block)
        return found[optics.reaches(found.means, found.scales, box)]

    def render(
        self, node: int, loaded: Loaded, seen: Sequence[Seen], settings: RenderSettings, active: int
    ) -> Iterator[FrozenLayers | None]:
        """Draw a node, loaded by `load`, for each of these views: cut by the window of the active block (by
        fragments) or put whole before or behind the active block (by means). None where the view sees
        nothing of it."""
        shown = [one for one in seen if loaded.shows_in(one.view)]
        if self.ownership == "means":
            drawn = self._put_whole(node, loaded, shown, settings, active)
        else:
            drawn = self._cut(node, loaded, shown, settings)
        for one in seen:
            yield next(drawn) if loaded.shows_in(one.view) else None

    def _cut(
        self, node: int, loaded: Loaded, seen: Sequence[Seen], settings: RenderSettings
    ) -> Iterator[FrozenLayers]:
        crops = [loaded.crops[one.view.index] for one in seen]
        rays = [one.rays.on(self.rasterizer.window_grid(crop)) for one, crop in zip(seen, crops, strict=True)]
        spans = ray_intervals(self.tree.box(node), rays)
        shots = [
            CutShot(one.view, crop, *span.cut_by(one.window.on(span.grid)))
            for one, crop, span in zip(seen, crops, spans, strict=True)
        ]
        others = loaded.own < len(loaded.gaussians)
        cuts = self.rasterizer.cuts(loaded.gaussians, shots, **vars(settings))
        for cut, shot in zip(cuts, shots, strict=True):
            # What reaches in from another node is inside that one's.
            own = cut.inside[torch.where(cut.kept_ids < loaded.own)[0]] if others else cut.inside
            yield FrozenLayers(cut.front, cut.back, own, shot.crop)

    @torch.no_grad()
    def _put_whole(
        self, node: int, loaded: Loaded, seen: Sequence[Seen], settings: RenderSettings, active: int
    ) -> Iterator[FrozenLayers]:
        for one in seen:
            layer = self.rasterizer(loaded.gaussians, one.view, crop=one.crop, **vars(settings)).layer
            nothing = self._nothing(one.view, one.crop)
            is_front = self.order((node, self.tree.node_of(active)), one.view)[0] == node
            front, back = (layer, nothing) if is_front else (nothing, layer)
            yield FrozenLayers(front, back, crop=one.crop)

    def raster(self, node: int, gaussians: Gaussians, view: View, settings: RenderSettings) -> Raster:
        """All that a view sees of a node, by fragments what lies within it; differentiable."""
        is_cut = node and self.ownership == "fragments"
        window = self.span(node, view, view.full) if is_cut else None
        return self.rasterizer.draw(gaussians, [Shot(view, view.full, None, window)], **vars(settings))[0]

    def span(self, node: int, view: View, crop: Crop) -> ZWindow:
        """Where the rays through the crop's tiles are inside a node."""
        return ray_interval(self.tree.box(node), view, self.rasterizer.window_grid(crop), self.device)

    @torch.no_grad()
    def order(self, nodes: Sequence[int], view: View) -> tuple[int, ...]:
        """The nodes front to back, as `view` sees them."""
        wanted, center = set(nodes), view.center.double().cpu()
        return tuple(node for node in nodes_in_order(self.tree, center) if node in wanted)

    def fold_up(
        self, parts: dict[int, Any], node: int, seen: Seen, fold: Callable[[Any, Any], Any] | None = None
    ) -> None:
        """Collapse what has come in with `node` and its neighbours in the tree, in place, as far as it goes.

        Whatever lies under a node is a run of the front-to-back order, so it folds by itself. Done after
        each node, what is held grows with the depth of the tree and not with the number of nodes.

        Args:
            parts: by node, FrozenLayers; None for one that shows nothing.
            fold: makes one of a near and a far part, if they are something else.
        """
        while node:
            node = self.tree.parent[node]
            near, far = node_children_in_order(self.tree, node, seen.center)
            if near not in parts or far not in parts:
                return
            front, behind = parts.pop(near), parts.pop(far)
            is_whole = front is not None and behind is not None
            parts[node] = (fold or _over)(front, behind) if is_whole else front or behind

    def fold(self, parts: dict[int, FrozenLayers | None], view: View, crop: Crop) -> FrozenLayers:
        """What `fold_up` has made of all nodes: one layer in front of the active block and one behind, and
        what is inside in one."""
        if parts[0] is None:
            return FrozenLayers(self._nothing(view, crop), self._nothing(view, crop), crop=crop)
        return _widened(parts[0], crop)

    @torch.no_grad()
    def picture(self, view: View, settings: RenderSettings, stop: float = 0.0) -> Raster:
        """The whole scene through layers, nearest node first: the composited render. `info` is empty. Once no
        pixel's transmittance is `stop` or more, nothing behind is drawn."""
        whole = self.nothing(view)
        for node, gaussians in self.loaded_in_order(view):
            whole = drawn_over(whole, self.raster(node, gaussians, view, settings))
            if float(whole.transmittance.max()) < stop:
                break
        return whole

    def loaded_in_order(self, view: View) -> Iterator[tuple[int, Gaussians]]:
        """Nodes front to back, each with its Gaussians that `view` may see, if there are any; loaded as they
        are asked for."""
        nodes = self.nodes()
        shown = self.shown(nodes, [(view, view.full)])
        for node in self.order(nodes, view):
            gaussians = self.load(shown[node]).gaussians
            if len(gaussians):
                yield node, gaussians

    def nothing(self, view: View) -> Raster:
        """A drawing of no Gaussians."""
        layer = self._nothing(view, view.full)
        return Raster(layer.color, layer.transmittance, torch.zeros_like(layer.transmittance), {})

    def _nothing(self, view: View, crop: Crop) -> Layer:
        return empty_layer(crop.height, crop.width, self.device, view.viewmat.dtype)

    def _descend(self, node: int, exclude: int | None) -> Iterator[int]:
        leaves = self.tree.leaves(node)
        blocks = [block for block in leaves if block != exclude]
        # By means, a node around the active block would be neither in front of it nor behind it.
        whole = self.ownership == "fragments" or len(blocks) == len(leaves)
        fits = sum(map(self.scene.count, blocks)) <= self._pass_gaussians
        if len(leaves) == 1 or (whole and fits):
            yield node
            return
        _, _, left, right, _ = self.tree.rows[node]
        yield from self._descend(left, exclude)
        yield from self._descend(right, exclude)


def drawn_over(front: Raster, behind: Raster) -> Raster:
    """One drawing of both, depth included."""
    layer = over(front.layer, behind.layer)
    depth = torch.addcmul(front.depth, front.transmittance, behind.depth)
    return Raster(layer.color, layer.transmittance, depth, {})


def _over(front: FrozenLayers, behind: FrozenLayers) -> FrozenLayers:
    """The parts of two nodes as one, `front` being the nearer."""
    inside = [part.inside.planes for part in (front, behind) if part.inside is not None and len(part.inside)]
    crop = front.crop.joined(behind.crop)
    front, behind = _widened(front, crop), _widened(behind, crop)
    splats = Splats(torch.cat(inside, dim=1)) if inside else None
    return FrozenLayers(over(front.front, behind.front), over(front.back, behind.back), splats, crop)


def _widened(part: FrozenLayers, crop: Crop) -> FrozenLayers:
    """The same on a crop that holds its own."""
    if part.crop == crop:
        return part
    at, wide = part.crop.within(crop).slices, []
    for layer in (part.front, part.back):
        empty = empty_layer(crop.height, crop.width, layer.color.device, layer.color.dtype)
        empty.color[at], empty.transmittance[at] = layer.color, layer.transmittance
        wide.append(empty)
    return FrozenLayers(*wide, part.inside, crop)


def default_pass(scene: BlockScene) -> int:
    """Frozen Gaussians to draw in one pass: room for twice the largest block, and for any small scene."""
    return max(2 * max(map(scene.count, range(scene.tree.num_blocks))), LEAST_PASS)
