"""Pictures of the whole scene, one node of it on the device at a time, and their gradient, by the pose say.

Every node is drawn without gradients and all are folded to the picture; a loss gives G = dL/dC; every node is
drawn again, with gradients, between what is before and behind it, see `sandwich`. What the pose gets from
each node is added up. Layers are cut where the rays of the given pose cross from cell to cell: a fragment
that moves over a border is the same in either layer, so that the gradient has no part of it.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import reduce

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.layers.compositing import fold, sandwich
from abcd_ns.engine.layers.layer_renderer import (
    BYTES_PER_PIXEL,
    PARTS_BYTES,
    LayerRenderer,
    Loaded,
    RenderSettings,
    Shown,
    drawn_over,
)
from abcd_ns.engine.render import Raster, Shot
from abcd_ns.engine.render.base import runs
from abcd_ns.engine.types import View


class WholePictures:
    """Draws a scene for it, or for poses, to be judged by: on black, not clamped, with no info. Layers held
    at a time take `layers_bytes`, unless a single view has more."""

    def __init__(
        self, renderer: LayerRenderer, settings: RenderSettings, layers_bytes: int = PARTS_BYTES
    ) -> None:
        self._renderer, self._settings, self._layers_bytes = renderer, settings, layers_bytes
        self._nodes = renderer.nodes()

    def groups(self, views: Sequence[View]) -> list[list[View]]:
        """Views whose layers have room at the same time: each group reads the scene twice."""
        pixels = self._layers_bytes // (len(self._nodes) * BYTES_PER_PIXEL)
        shots = [Shot(view, view.full) for view in views]
        return [[shot.view for shot in run] for run in runs(shots, pixels)]

    @torch.no_grad()
    def draw(self, views: Sequence[View]) -> Iterator[Raster]:
        """What each view sees, in order; the scene is read once for each of `groups`."""
        for group in self.groups(views):
            for view, own in zip(group, self._draw(group), strict=True):
                yield self._picture(view, own)

    def differentiate(
        self, views: Sequence[View], gradient: Callable[[View, Raster], Float[Tensor, "h w 3"]]
    ) -> list[Float[Tensor, "4 4"]]:
        """The gradient of a loss by each view's world-to-camera matrix, all of whose entries count as free.
        `gradient` gives dL/dC of a view's picture."""
        leaves = [replace(view, viewmat=view.viewmat.detach().clone().requires_grad_()) for view in views]
        self.backward(leaves, gradient)
        return [
            torch.zeros_like(view.viewmat) if view.viewmat.grad is None else view.viewmat.grad
            for view in leaves
        ]

    def backward(
        self,
        views: Sequence[View],
        gradient: Callable[[View, Raster], Float[Tensor, "h w 3"]],
        after: Callable[[], None] = lambda: None,
    ) -> None:
        """Leave the gradient of a loss, added up over views, in what of views and of the scene are leaves.

        Args:
            views: no more than have room, see `groups`.
            gradient: gives dL/dC of a view's picture.
            after: called when a node's fragments in a view have left theirs; those of other nodes are others.
        """
        if len(self._nodes) == 1:
            loaded = self._renderer.load(self._shown(views)[self._nodes[0]])
            for view in views:
                self._backward_through_one(loaded, view, gradient)
                after()
            return
        parts = self._draw(views)
        pulls = [gradient(view, self._picture(view, own)) for view, own in zip(views, parts, strict=True)]
        for node, shown in self._shown(views).items():
            loaded = self._renderer.load(shown)
            for view, own, pull in zip(views, parts, pulls, strict=True):
                if node in own:
                    self._differentiate(node, loaded, view, own, pull)
                after()

    def _backward_through_one(self, loaded: Loaded, view: View, gradient: Callable) -> None:
        """As `backward`, for a view, where one node is all: it is drawn once."""
        (node,) = self._nodes
        raster = self._raster(node, loaded, view) if loaded.shows_in(view) else None
        pull = gradient(view, self._picture(view, {} if raster is None else {node: _part(raster)}))
        if raster is not None:
            raster.color.backward(pull, retain_graph=True)  # views share what leads to the loaded Gaussians

    def _shown(self, views: Sequence[View]) -> dict[int, Shown]:
        return self._renderer.shown(self._nodes, [(view, view.full) for view in views])

    @torch.no_grad()
    def _draw(self, views: Sequence[View]) -> list[dict[int, Raster]]:
        """Of each view, the nodes that show in it, front to back."""
        parts: list[dict[int, Raster]] = [{} for _ in views]
        for node, shown in self._shown(views).items():
            loaded = self._renderer.load(shown)
            for view, own in zip(views, parts, strict=True):
                if loaded.shows_in(view):
                    own[node] = _part(self._raster(node, loaded, view))
        return [
            {node: own[node] for node in self._renderer.order(tuple(own), view)}
            for view, own in zip(views, parts, strict=True)
        ]

    def _raster(self, node: int, loaded: Loaded, view: View) -> Raster:
        return self._renderer.raster(node, loaded.gaussians, view, self._settings)

    def _picture(self, view: View, parts: Mapping[int, Raster]) -> Raster:
        return reduce(drawn_over, parts.values()) if parts else self._renderer.nothing(view)

    def _differentiate(
        self, node: int, loaded: Loaded, view: View, parts: Mapping[int, Raster], pull: Tensor
    ) -> None:
        at, layers = list(parts).index(node), [part.layer for part in parts.values()]
        front, back = fold(layers[:at], like=layers[at]), fold(layers[at + 1 :], like=layers[at])
        picture = sandwich(front, self._raster(node, loaded, view).layer, back, pull.new_zeros(3))
        picture.backward(pull, retain_graph=True)  # views share what leads to `loaded`


def _part(raster: Raster) -> Raster:
    return Raster(raster.color.detach(), raster.transmittance.detach(), raster.depth.detach(), {})
