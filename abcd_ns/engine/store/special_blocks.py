"""Names of what is no block, where a visit or the store holds it beside blocks, which have numbers from 0 on.

In a store a shard is found under each name, as under a block's number.
"""

from collections.abc import Iterable

BlockName = int | str  # a block's number, or one of these names

WHOLE = "whole"  # all blocks at once, where a visit names its block; nothing is stored under it
DEFERRED = "deferred"  # deferred points: Gaussians that join at the end of the warm-up
ACTIVE = "live"  # its name in stores
"""A block that was saved in the middle of its visit. Under its own number that block stays as the visit found
it: its windows hang on that."""
PENDING = "pending"  # migrants: Gaussians that left their block and join another at its next visit


def initial_of(block: int) -> str:
    """A block as it began, where each is trained alone."""
    return f"initial-{block}"


def from_text(text: str) -> BlockName:
    """What JSON has as a key: a number or a name."""
    return int(text) if text.isdecimal() else text


def in_order(names: Iterable[BlockName]) -> list[BlockName]:
    """Numbers first."""
    return sorted(names, key=lambda name: (isinstance(name, str), name))
