"""A scene as one immutable snapshot, assigned to a worker that trains a visit."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache

from abcd_ns.engine.gaussians.block_state import BlockState
from abcd_ns.engine.space.tree import BlockTree, Box
from abcd_ns.engine.store.scene import VisitScene
from abcd_ns.engine.store.special_blocks import BlockName
from abcd_ns.engine.types import Gaussians


@dataclass(frozen=True)
class Outlines:
    """What is known of every block without its Gaussians."""

    counts: Sequence[int]
    """Gaussians."""
    bounds: Sequence[Box | None]
    """See BlockScene."""


class AssignedScene(VisitScene):
    """The blocks of a moment: one with all that its training goes on from, the others to be drawn.

    Args:
        block: the one to be trained.
        state: what its visit begins with.
        drawn: by block, what reads its Gaussians as others draw them; called once, when they are drawn.
    """

    def __init__(
        self,
        tree: BlockTree,
        outlines: Outlines,
        block: int,
        state: BlockState,
        drawn: Mapping[int, Callable[[], Gaussians]],
    ) -> None:
        self.tree = tree
        self._outlines, self._block, self._state = outlines, block, state
        self._drawn = {number: cache(read) for number, read in drawn.items()}
        self._active: Callable[[], Gaussians] | None = None

    # What only the active block is asked for is of the assigned one, as its visit found it.

    def set_active(self, block: int | None, gaussians: Callable[[], Gaussians], sh_degree: int = 0) -> None:  # noqa: ARG002
        self._active = gaussians

    def state(self, name: BlockName) -> BlockState:  # noqa: ARG002
        return self._state

    def pending_for(self, block: int) -> BlockState | None:  # noqa: ARG002 - it has had them
        return None

    def rows(self, name: BlockName) -> int:
        return len(self.state(name))

    def stored_with_pending(self, block: int) -> Gaussians:
        return self.state(block).gaussians

    def gaussians(self, block: int) -> Gaussians:
        if block != self._block:
            return self._drawn[block]()
        return self._state.gaussians if self._active is None else self._active().detach()

    def as_drawn(self) -> Gaussians:
        """The assigned block as others draw it: without Gaussians that join in this visit."""
        return self._drawn[self._block]()

    def count(self, block: int) -> int:
        is_active = block == self._block and self._active is not None
        return len(self._active()) if is_active else self._outlines.counts[block]

    def bounds(self, block: int) -> Box | None:
        return self._outlines.bounds[block]
