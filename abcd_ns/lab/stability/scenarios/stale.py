"""Training against old pictures of the other blocks, which the engine refuses: to see what that does."""

from dataclasses import replace

import torch

from abcd_ns.engine.gaussians.block_state import BlockState
from abcd_ns.engine.store.scene import MemoryScene
from abcd_ns.engine.train.coordinator import Coordinator
from abcd_ns.engine.train.layer_source import LayerSource
from abcd_ns.engine.train.run import TrainingRun
from abcd_ns.engine.train.step.live_block import LiveBlock
from abcd_ns.engine.types import Gaussians


class OldNeighbours:
    """The other blocks as they were some visits ago, as a source of layers asks for them.

    Args:
        every: visits between two looks at the scene; 1 is always fresh.
    """

    def __init__(self, run: TrainingRun, every: int) -> None:
        self._run, self._every = run, every
        self._seen: MemoryScene | None = None
        self._taken_at = 0

    def __call__(self) -> MemoryScene:
        visit, scene = self._run.state.visit, self._run.scene
        if self._seen is None or visit - self._taken_at >= self._every:
            self._seen, self._taken_at = MemoryScene(scene.tree, scene.everything("cpu")), visit
        return self._seen


class DampedBlock(LiveBlock):
    """Keeps a share of what a visit did."""

    def __init__(self, run: TrainingRun, damping: float) -> None:
        super().__init__(run)
        self._share = damping

    def detached(self) -> BlockState:
        state, active = super().detached(), self._run.state.active
        if active is None or active.is_whole:
            return state
        before = self._run.scene.gaussians_at_rest(active.geometry.block)
        mixed = {n: torch.lerp(getattr(before, n), v, self._share) for n, v in state.gaussians.items()}
        return replace(state, gaussians=Gaussians(**mixed))  # moments are of the path, not of where it ends


def stale_coordinator(run: TrainingRun, every: int, damping: float = 1.0) -> Coordinator:
    """Shows blocks to each other as they were some visits ago.

    The number of Gaussians must stay (strategy "off", `migrate` off is not needed).

    Args:
        every: visits between two looks at the scene; 1 is always fresh.
        damping: what a visit did is kept to this share; 1 keeps all.
    """
    live = None if damping == 1.0 else DampedBlock(run, damping)
    return Coordinator(run, source=LayerSource(run, around=OldNeighbours(run, every)), live=live)
