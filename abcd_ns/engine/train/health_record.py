"""What is known of each block's health: counts of what was repaired, and its standing in words."""

from collections.abc import Mapping
from dataclasses import dataclass

from abcd_ns.engine.store.special_blocks import BlockName

TOO_FEW_VIEWS = 2
"""A block that no more views see has surfaces that nothing but the first Gaussians hold in place."""


@dataclass
class BlockHealth:
    """Of one block, since the run began: counts, and facts of its last visit."""

    visits: int = 0
    """That ended."""
    gradients: int = 0
    """Rows of gradients that were no numbers and were set to zero. On an accelerator the first steps that
    have any are skipped, and count as a row each."""
    moments: int = 0
    """Rows of Adam's moments likewise."""
    values: int = 0
    """Gaussians that were no numbers: put back as they were stored, or replaced by transparent ones."""
    oversized: int = 0
    """Gaussians that were shrunk."""
    pruned: int = 0
    """Gaussians that filled too little of their views and were taken out."""
    hidden: bool = False
    """In the last visit no picture showed the block."""


HealthByBlock = dict[BlockName, BlockHealth]
"""By block; special_blocks.WHOLE for the warm-up. A block that was never visited is missing."""


def standing(block: int, record: BlockHealth | None, views: Mapping[int, int]) -> str:
    """How a block stands, in a few words, where so many views, see RunState, were worth training it on."""
    if views.get(block) == 0:
        return "seen by no view, left as it was"
    if record is None or record.visits == 0:
        return "not visited yet"
    if record.hidden:
        return "hidden behind others, passed over"
    if views.get(block, TOO_FEW_VIEWS + 1) <= TOO_FEW_VIEWS:
        return "seen by 1 view only" if views[block] == 1 else f"seen by {views[block]} views only"
    return "trained"
