"""Blocks that were read or written lately, in RAM."""

from collections import OrderedDict

from abcd_ns.engine.gaussians.block_state import DRAWN, Packed
from abcd_ns.engine.store.special_blocks import BlockName


class BlockMemory:
    """Blocks by name under a limit of bytes: least recently used out first, what is drawn last of all."""

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self._drawn, self._training = OrderedDict[BlockName, Packed](), OrderedDict[BlockName, Packed]()

    @property
    def nbytes(self) -> int:
        """Of all that is here; added up anew, since a read may be broken off anywhere."""
        return sum(block.nbytes for kept in (self._drawn, self._training) for block in kept.values())

    def get(self, name: BlockName, *, whole: bool) -> Packed | None:
        """A block, or what others draw of it; None if that is not here."""
        parts = (self._drawn, self._training) if whole else (self._drawn,)
        if not all(name in kept for kept in parts):
            return None
        tensors = {}
        for kept in parts:
            kept.move_to_end(name)
            tensors |= kept[name].tensors
        return Packed(tensors, self._drawn[name].meta)

    def put(self, name: BlockName, block: Packed) -> None:
        """Keep a block, or what others draw of it, in place of what was here of it; `shrink` afterwards."""
        self.forget(name)
        self._drawn[name] = block.part(set(DRAWN))
        if training := block.tensors.keys() - set(DRAWN):
            self._training[name] = block.part(training)

    def forget(self, name: BlockName) -> None:
        for kept in (self._drawn, self._training):
            kept.pop(name, None)

    def shrink(self, spare: int = 0) -> None:
        """Let go of what exceeds the limit, less `spare` bytes; the Gaussians used last stay in any case."""
        beyond = self.nbytes + spare - self.limit
        while beyond > 0 and (self._training or len(self._drawn) > 1):
            _, gone = (self._training or self._drawn).popitem(last=False)
            beyond -= gone.nbytes
