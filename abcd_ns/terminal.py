"""Text for the terminal: lists and counts in sentences, facts in two columns, and plain lines."""

from collections.abc import Mapping, Sequence

from rich.console import Console

NAMED = 3  # of a list, how many are named


def print_plain(text: str, console: Console, style: str | None = None) -> None:
    """Print without markup and wrapping: names of files may look like markup, and are copied."""
    console.print(text, style=style, markup=False, emoji=False, highlight=False, soft_wrap=True)


def print_facts(facts: Mapping[str, str], console: Console) -> None:
    """Print names and values in two columns; long values are not wrapped, so that they can be copied."""
    width = max(map(len, facts))
    for name, value in facts.items():
        print_plain(f"{name:<{width}}  {value}", console)


def few(names: Sequence[str]) -> str:
    """The first names of a list, and how many more there are."""
    more = [f"{len(names) - NAMED} more"] if len(names) > NAMED else []
    return ", ".join([*names[:NAMED], *more])


def many(count: int, one: str, several: str) -> str:
    """`count` and the noun in its number, as "1 photo has" or "2 photos have"."""
    return f"{count:,} {one if count == 1 else several}"
