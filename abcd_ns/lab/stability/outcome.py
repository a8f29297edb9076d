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
    fails: str
    """What happens elsewhere."""
    done: str
    """What is done here to make it happen."""
    rule: str
    """What passes."""
    run: Callable[[Lab], Finding]


def scenario(id: str, fails: str, done: str, rule: str) -> Callable[[Callable[[Lab], Finding]], Scenario]:
    """Makes a scenario of the function that carries it out."""
    return lambda run: Scenario(id, fails, done, rule, run)
