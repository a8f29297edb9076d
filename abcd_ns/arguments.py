"""Options of `abcd` commands: how --help shows them, and which numbers they may be."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import tyro

from abcd_ns.errors import UserError

LOWEST = {"downscale": 1, "steps": 1, "evals": 1, "pictures": 0, "max_gaussians": 0}
"""The least that a number may be, by option; 1 for those that are not here."""
Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff, tyro.conf.arg(help_behavior_hint="")]  # a switch
Number = Annotated[int, tyro.conf.arg(metavar="N")]


def words(metavar: str, *aliases: str) -> Any:
    """How --help shows an option without a default of its own."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint="", aliases=aliases or None)


def check_ranges(given: Mapping[str, int | None], low: int = 1) -> None:
    """Raise a UserError if a number is below `LOWEST`, or `low` where that does not name it; None is none."""
    for name, value in given.items():
        least = LOWEST.get(name, low)
        if value is not None and value < least:
            raise UserError(f"--{name.replace('_', '-')} is {value}; it must be at least {least}.")


def check_numbers(option: str, numbers: Sequence[int], low: int) -> None:
    """Raise a UserError unless a list has different numbers from `low` up."""
    if not numbers or len(set(numbers)) < len(numbers) or min(numbers) < low:
        text = " ".join([option, *map(str, numbers)])
        raise UserError(f"{text}: give different numbers from {low} up.")
