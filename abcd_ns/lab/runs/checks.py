"""What is refused before a plan is made: options out of range, in words that name the option."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import tyro

from abcd_ns.errors import UserError

LOWEST = {"downscale": 1, "steps": 1, "evals": 1, "max_gaussians": 0, "pictures": 0}
"""The least that a number may be, by option; 1 for those that are not here."""
Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff, tyro.conf.arg(help_behavior_hint="")]
"""A switch."""
Number = Annotated[int, tyro.conf.arg(metavar="N")]


def words(metavar: str, *aliases: str) -> Any:
    """How --help shows an option without a default of its own."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint="", aliases=aliases or None)


def check_ranges(given: Mapping[str, int | None], low: int = 1) -> None:
    """Whether every number is as large as it must be; those that are None are passed over.

    Args:
        low: the least that those may be that `LOWEST` does not name.

    Raises:
        UserError: one is not.
    """
    for name, value in given.items():
        least = LOWEST.get(name, low)
        if value is not None and value < least:
            raise UserError(f"--{name.replace('_', '-')} is {value}; it must be at least {least}.")


def check_numbers(option: str, numbers: Sequence[int], low: int) -> None:
    """Whether a list has different numbers from `low` up.

    Raises:
        UserError: it has not.
    """
    if not numbers or len(set(numbers)) < len(numbers) or min(numbers) < low:
        text = " ".join([option, *map(str, numbers)])
        raise UserError(f"{text}: give different numbers from {low} up.")
