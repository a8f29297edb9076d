"""Text in the terminal as it is: names of files may look like markup or emoji."""

from collections.abc import Mapping

from rich.console import Console
from rich.table import Table
from rich.text import Text


def print_plain(text: str, console: Console, style: str | None = None) -> None:
    """Without markup and colours, and not wrapped, so that it can be copied."""
    console.print(text, style=style, markup=False, emoji=False, highlight=False, soft_wrap=True)


def print_facts(facts: Mapping[str, str], console: Console) -> None:
    """Two columns: what is told of, and what is told of it."""
    table = Table.grid(padding=(0, 2))
    for name, value in facts.items():
        table.add_row(Text(name), Text(value))
    console.print(table)
