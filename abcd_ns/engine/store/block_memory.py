"""Blocks that were read or written lately, in RAM."""

from collections import OrderedDict
from typing import NamedTuple

from torch import Tensor

from abcd_ns.engine.gaussians.block_state import BlockState, Clocks
from abcd_ns.engine.types import Gaussians


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
    """Blocks by number, under a limit of bytes: least recently used out first, Gaussians last of all."""

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.nbytes = 0
        self._gaussians: OrderedDict[int, Gaussians] = OrderedDict()
        self._training: OrderedDict[int, _Training] = OrderedDict()

    def gaussians(self, number: int) -> Gaussians | None:
        """Those of a block, if they are here."""
        return _used(self._gaussians, number)

    def state(self, number: int) -> BlockState | None:
        """A whole block, if all of it is here."""
        gaussians, training = _used(self._gaussians, number), _used(self._training, number)
        return None if gaussians is None or training is None else BlockState(gaussians, *training)

    def put(self, number: int, block: BlockState | Gaussians) -> None:
        """Keep a block, or its Gaussians alone, in place of what was here of it; `shrink` afterwards."""
        self.forget(number)
        if isinstance(block, BlockState):
            training = _Training(block.exp_avg, block.exp_avg_sq, block.growth, block.clocks)
            self._training[number] = training
            self.nbytes += training.nbytes
            block = block.gaussians
        self._gaussians[number] = block
        self.nbytes += block.nbytes

    def forget(self, number: int) -> None:
        """Let a block go."""
        for kept in (self._gaussians, self._training):
            found = kept.pop(number, None)
            self.nbytes -= 0 if found is None else found.nbytes

    def shrink(self, spare: int = 0) -> None:
        """Let go of what goes beyond the limit; the Gaussians used last stay in any case.

        Args:
            spare: bytes that are taken otherwise and count against the limit.
        """
        while self.nbytes + spare > self.limit and (self._training or len(self._gaussians) > 1):
            _, gone = (self._training or self._gaussians).popitem(last=False)
            self.nbytes -= gone.nbytes


def _used(kept: OrderedDict, number: int):
    """What is kept under a number, which is the one used last from now on."""
    if number not in kept:
        return None
    kept.move_to_end(number)
    return kept[number]
