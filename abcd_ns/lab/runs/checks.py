"""What is refused before a plan is made: options out of range, in words that name the option."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro

from abcd_ns.errors import UserError
from abcd_ns.lab.job import Settings

LOWEST = {"downscale": 1, "blocks": 1, "steps": 1, "evals": 1, "max_gaussians": 0, "pictures": 0}
"""The least that a number may be, by option; 1 for those that are not here."""
Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff, tyro.conf.arg(help_behavior_hint="")]
"""A switch."""
Number = Annotated[int, tyro.conf.arg(metavar="N")]
Numbers = Annotated[tuple[int, ...], tyro.conf.arg(metavar="N ...")]


def words(metavar: str, *aliases: str) -> Any:
    """How --help shows an option without a default of its own."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint="", aliases=aliases or None)


def make_settings(data: Any, out: Any, seeds: Sequence[int], **given: Any) -> Settings:
    """What all runs of a plan share; `given` are the fields of `Settings` but for `data`.

    Raises:
        UserError: an option is missing, out of range or contradicts another.
    """
    # Here and not above: torch takes seconds to import, and `--help` has no use for it.
    from abcd_ns.engine.space.partition import MAX_BLOCKS

    if data is None:
        raise UserError("Give the scene with --data FOLDER.")
    if out is None:
        raise UserError("Give the folder for the results with --out FOLDER.")
    if not Path(data).exists():
        raise UserError(f"--data {data} does not exist.")
    seconds = given["seconds"]
    if (seconds is None) == (given["steps"] is None):
        raise UserError("Give each run's budget: either --seconds or --steps.")
    if seconds is not None and not 0 < seconds < float("inf"):
        raise UserError(f"--seconds is {seconds}; it must be above 0 and finite.")
    check_ranges({name: given[name] for name in LOWEST})
    if given["blocks"] > MAX_BLOCKS:
        raise UserError(f"--blocks is {given['blocks']}; it must be at most {MAX_BLOCKS}.")
    check_numbers("--seeds", seeds, 0)
    return Settings(data=str(Path(data).resolve()), **given)


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


def check_numbers(option: str, numbers: Sequence[int], low: int, several: bool = False) -> None:
    """Whether a list has different numbers from `low` up, at least two of them if there must be several.

    Raises:
        UserError: it has not.
    """
    if not numbers or len(set(numbers)) < len(numbers) or min(numbers) < low:
        text = " ".join([option, *map(str, numbers)])
        raise UserError(f"{text}: give different numbers from {low} up.")
    if several and len(numbers) < 2:
        raise UserError(f"{option} {numbers[0]}: give at least two numbers, to compare them.")
