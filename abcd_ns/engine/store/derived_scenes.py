"""Scenes that show another one: with something changed, or held on a device."""

from collections.abc import Callable

import torch

from abcd_ns.engine.space.tree import Box
from abcd_ns.engine.store.scene import BlockScene
from abcd_ns.engine.types import Gaussians


class _Derived(BlockScene):
    """Blocks as many and as far out as another scene's."""

    def __init__(self, scene: BlockScene) -> None:
        self.tree, self._scene = scene.tree, scene

    def count(self, block: int) -> int:
        return self._scene.count(block)

    def bounds(self, block: int) -> Box | None:
        return self._scene.bounds(block)


class ChangedScene(_Derived):
    """A scene of whose blocks `change` says what is seen, by number and Gaussians: as many or fewer, none of
    them farther out, for counts and bounds stay those of all."""

    def __init__(self, scene: BlockScene, change: Callable[[int, Gaussians], Gaussians]) -> None:
        super().__init__(scene)
        self._change = change

    def gaussians(self, block: int) -> Gaussians:
        return self._change(block, self._scene.gaussians(block))


class HeldScene(_Derived):
    """A scene's blocks on a device while none changes: read once, as far as there is room, bytes."""

    def __init__(self, scene: BlockScene, device: torch.device, room: int) -> None:
        super().__init__(scene)
        self._device, self._room = device, room
        self._held: dict[int, Gaussians] = {}

    def gaussians(self, block: int) -> Gaussians:
        if block in self._held:
            return self._held[block]
        found = self._scene.drawn(block, self._device)
        if found.nbytes <= self._room:
            self._room -= found.nbytes
            self._held[block] = found
        return found
