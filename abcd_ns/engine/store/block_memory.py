"""Blocks that were read or written lately, in RAM."""

from collections import OrderedDict
from typing import NamedTuple

from torch import Tensor

from abcd_ns.engine.gaussians.block_state import BlockState, Clocks
from abcd_ns.engine.store.special_blocks import BlockName
from abcd_ns.engine.types import Gaussians


class AtRest(NamedTuple):
    """What others draw of a block at rest, or will."""

    gaussians: Gaussians
    waits: Tensor
    """Bool [n]: who is not to be seen before the block's next visit."""

    @property
    def seen(self) -> Gaussians:
        """Without those that wait."""
        return self.gaussians[~self.waits] if bool(self.waits.any()) else self.gaussians

    @property
    def nbytes(self) -> int:
        return self.gaussians.nbytes + self.waits.nbytes


class _Training(NamedTuple):
    """What only a visit to the block itself needs."""

    exp_avg: Gaussians
    exp_avg_sq: Gaussians
    growth: dict[str, Tensor]
    clocks: Clocks

    @property
    def nbytes(self) -> int:
        growth = sum(value.nbytes for value in self.growth.values())
        return self.exp_avg.nbytes + self.exp_avg_sq.nbytes + growth


class BlockMemory:
    """Blocks by name, under a limit of bytes: least recently used out first, Gaussians last of all."""

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.nbytes = 0
        self._rest: OrderedDict[BlockName, AtRest] = OrderedDict()
        self._training: OrderedDict[BlockName, _Training] = OrderedDict()

    def at_rest(self, name: BlockName) -> AtRest | None:
        """What is drawn of a block, if it is here."""
        return _used(self._rest, name)

    def state(self, name: BlockName) -> BlockState | None:
        """A whole block, if all of it is here."""
        rest, training = _used(self._rest, name), _used(self._training, name)
        return None if rest is None or training is None else BlockState(rest.gaussians, *training, rest.waits)

    def put(self, name: BlockName, block: BlockState | AtRest) -> None:
        """Keep a block, or its Gaussians alone, in place of what was here of it; `shrink` afterwards."""
        self.forget(name)
        if isinstance(block, BlockState):
            training = _Training(block.exp_avg, block.exp_avg_sq, block.growth, block.clocks)
            self._training[name] = training
            self.nbytes += training.nbytes
            block = AtRest(block.gaussians, block.waits)
        self._rest[name] = block
        self.nbytes += block.nbytes

    def forget(self, name: BlockName) -> None:
        """Let a block go."""
        for kept in (self._rest, self._training):
            found = kept.pop(name, None)
            self.nbytes -= 0 if found is None else found.nbytes

    def shrink(self, spare: int = 0) -> None:
        """Let go of what goes beyond the limit; the Gaussians used last stay in any case.

        Args:
            spare: bytes that are taken otherwise and count against the limit.
        """
        while self.nbytes + spare > self.limit and (self._training or len(self._rest) > 1):
            _, gone = (self._training or self._rest).popitem(last=False)
            self.nbytes -= gone.nbytes


def _used(kept: OrderedDict, name: BlockName):
    """What is kept under a name, which is the one used last from now on."""
    if name not in kept:
        return None
    kept.move_to_end(name)
    return kept[name]
