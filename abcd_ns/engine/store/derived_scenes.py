"""Scenes that show another one, with its counts and bounds: with something changed, or held on a device."""

from collections.abc import Callable

import torch

from abcd_ns.engine.store.scene import BlockScene
from abcd_ns.engine.types import Gaussians


class ChangedScene(BlockScene):
    """A scene of whose blocks `change` says what is seen, by number and Gaussians: as many or fewer, none of
    them farther out, for counts and bounds stay those of all."""

    def __init__(self, scene: BlockScene, change: Callable[[int, Gaussians], Gaussians]) -> None:
        self.tree, self.count, self.bounds = scene.tree, scene.count, scene.bounds
        self._scene, self._change = scene, change

    def gaussians(self, block: int) -> Gaussians:
        return self._change(block, self._scene.gaussians(block))


class HeldScene(BlockScene):
    """A scene's blocks on a device while none changes: read once, as far as there is room, bytes."""

    def __init__(self, scene: BlockScene, device: torch.device, room: int) -> None:
        self.tree, self.count, self.bounds = scene.tree, scene.count, scene.bounds
        self._scene, self._device, self._room = scene, device, room
        self._held: dict[int, Gaussians] = {}

    def gaussians(self, block: int) -> Gaussians:
        if block in self._held:
            return self._held[block]
        found = self._scene.drawn(block, self._device)
        if found.nbytes <= self._room:
            self._room -= found.nbytes
            self._held[block] = found
        return found
