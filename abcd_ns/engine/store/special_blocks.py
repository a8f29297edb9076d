"""Numbers that are no block's, under which a visit or the store names something else than a block.

No tree has so many blocks. In a store a shard is found under each, as under a block's number.
"""

WHOLE = -1
"""All blocks at once, where a visit names its block; nothing is stored under it."""
RESERVE = 1 << 20
"""The Gaussians that wait for the end of the warm-up."""
LIVE = RESERVE + 1
"""A block that was saved in the middle of its visit. Under its own number that block stays as the visit found
it: its windows hang on that."""
INBOX = RESERVE + 2
"""Gaussians that left their block and wait for the next visit to the one that holds them now."""
_INITIAL = 1 << 21


def initial_of(block: int) -> int:
    """A block as it began, where each is trained alone."""
    return _INITIAL + block
