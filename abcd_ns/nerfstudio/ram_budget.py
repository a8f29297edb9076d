"""How the RAM that a run may keep things in is shared out."""

from dataclasses import dataclass

import psutil

MOST_BYTES = 8 << 30
"""Of the automatic budget."""
SHARE_OF_MACHINE = 0.4
"""Of the machine's memory, where that is less."""


@dataclass(frozen=True)
class RamShares:
    """Bytes for each place that keeps what could be read or drawn again. None of them changes a result."""

    photos: int
    """Decoded photos."""
    blocks: int
    """Frozen blocks, read from the store."""
    layers: int
    """A visit's layers; where there is a GPU, those that have no room there."""


def share_out(budget: int) -> RamShares:
    """A quarter of `budget` bytes for photos, one for blocks, the rest for layers."""
    photos = blocks = budget // 4
    return RamShares(photos, blocks, budget - photos - blocks)


def budget_bytes(gigabytes: float) -> int:
    """The budget in bytes; 0 GB is the smaller of 8 GiB and 40% of the machine's memory."""
    if gigabytes:
        return int(gigabytes * 2**30)
    return min(MOST_BYTES, int(SHARE_OF_MACHINE * psutil.virtual_memory().total))
