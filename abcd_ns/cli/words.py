"""Lists and counts in sentences."""

from collections.abc import Sequence

NAMED = 3
"""Of a list, how many are named."""


def few(names: Sequence[str], count: int | None = None) -> str:
    """The first names of a list, and how many more there are.

    Args:
        count: of the whole list, where `names` is only its beginning.
    """
    shown, count = list(names[:NAMED]), len(names) if count is None else count
    more = [f"{count - len(shown)} more"] if count > len(shown) else []
    return ", ".join(shown + more)


def many(count: int, one: str, several: str) -> str:
    """`count` and the noun in its number, as "1 photo has" or "2 photos have"."""
    return f"{count:,} {one if count == 1 else several}"
