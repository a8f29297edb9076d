"""What is refused before a plan is made: options out of range, in words that name the option."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from abcd_ns.errors import UserError

LOWEST = {"downscale": 1, "blocks": 1, "steps": 1, "evals": 1, "max_gaussians": 0, "pictures": 0}
"""The least that a number may be, by option."""


def check_places(data: str | None, out: str | None) -> None:
    """Whether there are a scene and a folder for the results.

    Raises:
        UserError: one of them is missing.
    """
    if data is None:
        raise UserError("Give the scene with --data FOLDER.")
    if out is None:
        raise UserError("Give the folder for the results with --out FOLDER.")
    if not Path(data).exists():
        raise UserError(f"--data {data} does not exist.")


def check_budget(seconds: float | None, steps: int | None) -> None:
    """Whether a run has one budget.

    Raises:
        UserError: it has none, or two, or no sensible one.
    """
    if (seconds is None) == (steps is None):
        raise UserError("Give each run's budget: either --seconds or --steps.")
    if seconds is not None and not 0 < seconds < float("inf"):
        raise UserError(f"--seconds is {seconds}; it must be above 0.")


def check_ranges(given: Mapping[str, int | None]) -> None:
    """Whether every number is as large as it must be; those that are None are passed over.

    Raises:
        UserError: one is not.
    """
    for name, value in given.items():
        low = LOWEST[name]
        if value is not None and value < low:
            raise UserError(f"--{name.replace('_', '-')} is {value}; it must be at least {low}.")


def check_numbers(option: str, numbers: Sequence[int], low: int) -> None:
    """Whether a list has different numbers from `low` up.

    Raises:
        UserError: it has not.
    """
    if not numbers or len(set(numbers)) < len(numbers) or min(numbers) < low:
        words = " ".join([option, *map(str, numbers)])
        raise UserError(f"{words}: give different numbers from {low} up.")
