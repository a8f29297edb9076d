"""What a scenario is, and what it finds out."""

from collections.abc import Callable
from dataclasses import dataclass, field

from abcd_ns.lab.stability.lab import Lab


@dataclass(frozen=True)
class Finding:
    """What a scenario found out."""

    passed: bool
    """By ABCD, under the scenario's rule."""
    said: dict[str, str]
    """By method, what it did, in a few words."""
    numbers: dict[str, float] = field(default_factory=dict)
    """What the rule was applied to, by name; finite."""
    worse: bool = False
    """Whether ABCD did worse than one block, whatever the rule says."""


@dataclass(frozen=True)
class Scenario:
    """One way in which methods fail."""

    id: str
    """A1 to A22."""
    fails: str
    """What happens elsewhere."""
    done: str
    """What is done here to make it happen."""
    rule: str
    """What passes."""
    run: Callable[[Lab], Finding]
    cost: int = 1
    """How long it takes, in trainings of a curve's point; for the time left."""


def scenario(
    id: str, fails: str, done: str, rule: str, cost: int = 1
) -> Callable[[Callable[[Lab], Finding]], Scenario]:
    """Makes a scenario of the function that carries it out."""
    return lambda run: Scenario(id, fails, done, rule, run, cost)


def db(value: float) -> str:
    """In decibels, with two digits."""
    return f"{value:.2f} dB"


def against_one_block(scores: dict[str, float], margin: float = 0.3) -> Finding:
    """The finding of a scenario that asks for no less than one block reaches, less `margin` dB.

    Args:
        scores: held-out PSNR by method, "abcd" and "abcd-monolithic" among them.
    """
    behind = scores["abcd-monolithic"] - scores["abcd"]
    numbers = {f"psnr {method}": value for method, value in scores.items()}
    said = {method: db(value) for method, value in scores.items()}
    return Finding(behind <= margin, said, {**numbers, "behind one block": behind}, worse=behind > 0)
