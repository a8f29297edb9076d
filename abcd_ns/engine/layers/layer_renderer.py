"""Draws frozen blocks into layers, as many blocks in one pass as the device has room for.

With ownership by *fragments* (docs/design.md) a layer holds the fragments of one convex node of the
block tree, drawn from all Gaussians that reach into it, so that folding layers gives the merged picture.
With ownership by *means* a layer holds a node's own Gaussians whole, as the paper has it.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import torch
from jaxtyping import Float64
from torch import Tensor

from abcd_ns.engine.layers.compositing import empty_layer, over
from abcd_ns.engine.render import CutShot, Raster, Rasterizer, Shot, ZWindow
from abcd_ns.engine.render.projection import Splats
from abcd_ns.engine.space.culling import Frusta, Optics
from abcd_ns.engine.space.intervals import ray_interval
from abcd_ns.engine.space.tree import BlockTree, Box, node_children_in_order, nodes_in_order
from abcd_ns.engine.space.visibility import reaches
from abcd_ns.engine.store.scene import BlockScene
from abcd_ns.engine.types import Crop, Gaussians, Layer, View

Ownership = Literal["fragments", "means"]
PARTS_BYTES = 256 << 20
"""Size of the layers held while nodes are folded, at most, unless those of a single view are larger, or there
is more room for them. Each group of views that has room loads the scene once."""
BYTES_PER_PIXEL = 32
"""Of a front and a back layer in float32, or of one with its depth."""
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


@dataclass(frozen=True)
class Seen:
    """Whose picture is drawn."""

    view: View
    crop: Crop
    window: ZWindow | None = None
    """Of the active block, by fragments: what lies in it is drawn neither in front nor behind."""


@dataclass(frozen=True)
class Loaded:
    """A node's Gaussians on the device."""

    gaussians: Gaussians
    """Its own, then those of other nodes that reach into it."""
    own: int
    """How many are its own."""
    seen: frozenset[int]
    """Indices of the views that may see something of the node."""

    def shows_in(self, view: View) -> bool:
        """Whether `view` may see something of the node; False is certain."""
        return len(self.gaussians) > 0 and view.index in self.seen


class LayerRenderer:
    """Draws the frozen blocks of a scene.

    Args:
        scene: where Gaussians are read from.
        views: all views that will be drawn; they bound how far Gaussians reach.
        pass_gaussians: the most Gaussians that one drawing may take on the device. A node of the tree
            that holds more is drawn in parts, down to single blocks.
    """

    def __init__(
        self,
        scene: BlockScene,
        views: list[View],
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
        self._optics = Optics(views, rasterizer.slack)
        self._drawn: dict[int, tuple[Box | None, Tensor | None]] = {}

    @property
    def tree(self) -> BlockTree:
        return self.scene.tree

    def frusta(self, seen: Iterable[tuple[View, Crop]]) -> Frusta:
        """What crops look at, for `load`."""
        return Frusta(seen, self.rasterizer.slack)

    def nodes(self, exclude: int | None = None) -> tuple[int, ...]:
        """Nodes of the tree that tile space and hold every block but `exclude`, each to be drawn in one pass.

        Where no other node holds the cell of `exclude` it is one of them: by fragments for what reaches into
        it, by means for its place in the order.
        """
        return tuple(self._descend(0, exclude))

    def depth_of(self, node: int) -> int:
        """How many nodes are above a node."""
        depth = 0
        while node:
            node, depth = int(self.tree.parent[node]), depth + 1
        return depth

    def load(self, node: int, seen_by: Frusta, exclude: int | None = None) -> Loaded:
        """On the device: the Gaussians of the node's blocks and, by fragments, all others that reach in.

        Args:
            seen_by: keep to blocks of which something may show in these crops; others are not even read.
        """
        inside = [b for b in self.tree.leaves(node) if b != exclude]
        outside: list[int] = []
        if self.ownership == "fragments" and node != 0:
            outside = [b for b in range(self.tree.num_blocks) if b not in set(inside) and b != exclude]
        shown = self._shown(node, [*inside, *outside], seen_by)
        inside, outside = ([b for b in some if b in shown] for some in (inside, outside))
        views = (view for k, (view, _) in enumerate(seen_by.seen) if any(row[k] for row in shown.values()))
        parts = [self.scene.drawn(block, self.device) for block in inside]
        own, box = sum(map(len, parts)), self.tree.box(node)
        parts += [self.scene.drawn(block, self.device, partial(self._reach, box)) for block in outside]
        return Loaded(
            Gaussians.cat(parts) if parts else Gaussians.empty(device=self.device),
            own,
            frozenset(view.index for view in views),
        )

    def _shown(self, node: int, blocks: Sequence[int], seen_by: Frusta) -> dict[int, list[bool]]:
        """Of these blocks, those with fragments in the node that some crop may show, and which crops."""
        boxes = {b: box for b in blocks if (box := self._drawn_within(b)) is not None}
        if self.ownership == "fragments" and boxes:
            space, lower, upper = self.tree.box(node), *torch.stack(list(boxes.values())).unbind(1)
            shared = torch.stack((lower.maximum(space.lower), upper.minimum(space.upper)), dim=1)
            meets = (shared[:, 0] <= shared[:, 1]).all(dim=1).tolist()
            boxes = {b: box for b, box, meet in zip(boxes, shared, meets, strict=True) if meet}
        rows = seen_by.may_show([Box(*box) for box in boxes.values()]).tolist()
        return {b: row for b, row in zip(boxes, rows, strict=True) if any(row)}

    def _drawn_within(self, block: int) -> Float64[Tensor, "2 3"] | None:
        """Corners of the box that a block's fragments lie in; kept while its bounds are."""
        bounds = self.scene.bounds(block)
        if block not in self._drawn or self._drawn[block][0] is not bounds:
            box = None if bounds is None else self._optics.drawn_within(bounds)
            self._drawn[block] = bounds, None if box is None else torch.stack((box.lower, box.upper))
        return self._drawn[block][1]

    def _reach(self, box: Box, means: Tensor, scales: Tensor) -> Tensor:
        """Which Gaussians some view may see inside a box, [n]."""
        return reaches(means, scales, box, self._optics.slack(means), self._optics.slant)

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
        spans = (self.span(node, one.view, one.crop) for one in seen)
        shots = [
            CutShot(one.view, one.crop, span.before(one.window), one.window, span.behind(one.window))
            for one, span in zip(seen, spans, strict=True)
        ]
        others = loaded.own < len(loaded.gaussians)
        for cut in self.rasterizer.cuts(loaded.gaussians, shots, **vars(settings)):
            # What reaches in from another node is inside that one's.
            own = cut.inside[torch.where(cut.kept_ids < loaded.own)[0]] if others else cut.inside
            yield FrozenLayers(cut.front, cut.back, own)

    @torch.no_grad()
    def _put_whole(
        self, node: int, loaded: Loaded, seen: Sequence[Seen], settings: RenderSettings, active: int
    ) -> Iterator[FrozenLayers]:
        for one in seen:
            layer = self.rasterizer(loaded.gaussians, one.view, crop=one.crop, **vars(settings)).layer
            nothing = self._nothing(one.view, one.crop)
            is_front = self.order((node, self.tree.node_of(active)), one.view)[0] == node
            yield FrozenLayers(layer, nothing) if is_front else FrozenLayers(nothing, layer)

    def raster(self, node: int, gaussians: Gaussians, view: View, settings: RenderSettings) -> Raster:
        """All that a view sees of a node, by fragments what lies within it; differentiable."""
        window = None
        if self.ownership == "fragments" and node:
            window = self.span(node, view, view.full)
        return self.rasterizer.draw(gaussians, [Shot(view, view.full, None, window)], **vars(settings))[0]

    @torch.no_grad()
    def span(self, node: int, view: View, crop: Crop) -> ZWindow:
        """Where the rays through the crop's tiles are inside a node."""
        grid = self.rasterizer.window_grid(crop)
        if node == 0:
            return ZWindow.everything(grid, self.device, view.viewmat.dtype)
        return ray_interval(self.tree.box(node), view, grid, self.device)

    @torch.no_grad()
    def order(self, nodes: Sequence[int], view: View) -> tuple[int, ...]:
        """The nodes front to back, as `view` sees them."""
        wanted, center = set(nodes), view.center.double().cpu()
        return tuple(node for node in nodes_in_order(self.tree, center) if node in wanted)

    def fold_up(self, parts: dict[int, FrozenLayers | None], node: int, view: View) -> None:
        """Collapse what has come in with `node` and its neighbours in the tree, in place, as far as it goes.

        Whatever lies under a node is a run of the front-to-back order, so it folds by itself. Done after
        each node, what is held grows with the depth of the tree and not with the number of nodes.

        Args:
            parts: by node; None for one that shows nothing.
        """
        center = view.center.double().cpu()
        while node:
            node = int(self.tree.parent[node])
            near, far = node_children_in_order(self.tree, node, center)
            if near not in parts or far not in parts:
                return
            parts[node] = _over(parts.pop(near), parts.pop(far))

    def fold(self, parts: dict[int, FrozenLayers | None], view: View, crop: Crop) -> FrozenLayers:
        """What `fold_up` has made of all nodes: one layer in front of the active block and one behind, and
        what is inside in one."""
        nothing = self._nothing(view, crop)
        return parts[0] or FrozenLayers(nothing, nothing)

    @torch.no_grad()
    def picture(self, view: View, settings: RenderSettings, stop: float = 0.0) -> Raster:
        """The whole scene through layers, nearest node first: the composited render. `info` is empty.

        Args:
            stop: transmittance below which nothing behind is drawn, if no pixel has more.
        """
        whole, seen_by = self.nothing(view), self.frusta([(view, view.full)])
        for node in self.order(self.nodes(), view):
            if float(whole.transmittance.max()) < stop:
                break
            gaussians = self.load(node, seen_by).gaussians
            if len(gaussians):
                whole = drawn_over(whole, self.raster(node, gaussians, view, settings))
        return whole

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
        yield from self._descend(int(self.tree.left[node]), exclude)
        yield from self._descend(int(self.tree.right[node]), exclude)


def drawn_over(front: Raster, behind: Raster) -> Raster:
    """One drawing of both, depth included."""
    layer = over(front.layer, behind.layer)
    depth = torch.addcmul(front.depth, front.transmittance, behind.depth)
    return Raster(layer.color, layer.transmittance, depth, {})


def _over(front: FrozenLayers | None, behind: FrozenLayers | None) -> FrozenLayers | None:
    """The parts of two nodes as one, `front` being the nearer; None shows nothing."""
    if front is None or behind is None:
        return behind if front is None else front
    inside = [part.inside.planes for part in (front, behind) if part.inside is not None and len(part.inside)]
    return FrozenLayers(
        over(front.front, behind.front),
        over(front.back, behind.back),
        Splats(torch.cat(inside, dim=1)) if inside else None,
    )


def default_pass(scene: BlockScene) -> int:
    """Frozen Gaussians to draw in one pass: room for twice the largest block, and for any small scene."""
    return max(2 * max(map(scene.count, range(scene.tree.num_blocks))), LEAST_PASS)
