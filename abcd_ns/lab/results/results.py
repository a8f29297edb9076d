"""results.json: everything that an experiment found, with what is needed to do it again."""

import re
from dataclasses import dataclass
from statistics import fmean
from typing import Any

from abcd_ns.lab.job import Settings
from abcd_ns.lab.results.run import Failure, Run
from abcd_ns.machine import Machine, Versions
from abcd_ns.units import bytes_in_words

SCHEMA = 2
"""Raised whenever a field changes its name or meaning."""
RESULTS_FILE = "results.json"
TERRAIN = "comparison of sizes"
"""The kind of results of `abcd compare --tiles`, where nothing is held out."""


@dataclass(frozen=True)
class Arm:
    """One method with one thing set, and its runs."""

    method: str
    variant: str
    """What is set: `blocks=4`, or "default"."""
    value: int | None
    """What it is set to, where that is a whole number."""
    runs: tuple[Run, ...]
    """One for each seed that did not fail."""

    @property
    def name(self) -> str:
        """The method, and what of it is set."""
        return self.method if self.variant == "default" else f"{self.method} {self.variant}"

    def mean(self, field: str) -> float:
        """Over the seeds, of a field of `Run` that all of them know."""
        return fmean(getattr(run, field) for run in self.runs)


@dataclass(frozen=True)
class LeftOut:
    """A method that was asked for and cannot run here."""

    method: str
    reason: str


@dataclass(frozen=True)
class Outcome:
    """One way in which methods fail, and what came of it here."""

    id: str
    fails: str
    """What happens elsewhere."""
    done: str
    """What is done here to make it happen."""
    rule: str
    """What passes."""
    passed: bool
    worse: bool
    """Whether ABCD did worse than one block, whatever the rule says."""
    said: dict[str, str]
    """By method, what it did, in a few words."""
    numbers: dict[str, float]
    """What the rule was applied to, by name."""
    seconds: float


@dataclass(frozen=True)
class Results:
    """The whole of results.json."""

    schema: int
    kind: str
    """Of the experiment: "comparison", "stability report"; older ones have "study of ..." too."""
    date: str
    """ISO 8601, UTC."""
    command: str
    """The command line that makes the same, without where its folders are."""
    machine: Machine
    versions: Versions
    settings: Settings | None = None
    """What all runs share, `data` being the name of the scene alone; None where nothing is held out."""
    seeds: tuple[int, ...] = ()
    arms: tuple[Arm, ...] = ()
    """Those with a run."""
    outcomes: tuple[Outcome, ...] = ()
    curves: tuple[dict[str, Any], ...] = ()
    """Of older stability reports: held-out PSNR against one thing each."""
    failures: tuple[Failure, ...] = ()
    left_out: tuple[LeftOut, ...] = ()
    findings: tuple[str, ...] = ()
    """What the experiment says, a sentence each."""
    notes: tuple[str, ...] = ()
    """What a reader of the table has to know."""

    @property
    def means_of(self) -> str:
        """What an arm's numbers are means of, in words; empty where each has but one run."""
        runs = sorted(len(arm.runs) for arm in self.arms) or [1]
        few = "" if runs[0] == runs[-1] else f"{runs[0]} to "
        return f"mean of {few}{runs[-1]} seeds" if runs[-1] > 1 else ""

    @property
    def title(self) -> str:
        """Scene, size, blocks, budget and seeds, as charts have them; empty where nothing is held out."""
        if (s := self.settings) is None:
            return ""
        blocks = [f"{s.blocks} block{'s' * (s.blocks > 1)}"] if s.blocks else []
        means = [self.means_of] if self.means_of else []
        return ", ".join([s.scene, f"1/{s.downscale} size", *blocks, s.budget, *means])

    def of(self, method: str) -> tuple[Arm, ...]:
        """The method's arms, in their order."""
        return tuple(arm for arm in self.arms if arm.method == method)

    @property
    def labels(self) -> dict[str, str]:
        """By name of an arm, what a chart calls it: `abcd, 8 blocks, warmup=0`; of one method `8 blocks`."""
        found = {}
        for arm in self.arms:
            words = [re.sub(r"^[\w.]+\.(\w+=)", r"\1", word) for word in arm.variant.split()]
            words = [re.sub(r"^(block|tile)s=(\d+)$", r"\2 \1s", word) for word in words]
            words = [re.sub(r"^1 (\w+)s$", r"1 \1", word) for word in words if word != "default"]
            words = [re.sub(r"^gaussian_bytes=(\d+)$", lambda m: bytes_in_words(int(m[1])), w) for w in words]
            found[arm.name] = ", ".join([arm.method] * (len(self.methods) > 1) + words) or arm.method
        return found

    def baseline(self, arm: Arm) -> Arm | None:
        """The arm of the same method and number of blocks without the changes, if there is any."""
        arms = {other.variant: other for other in self.of(arm.method) if other is not arm}
        blocks = " ".join(word for word in arm.variant.split() if word.startswith("blocks="))
        return arms.get(blocks, arms.get("default"))

    @property
    def methods(self) -> tuple[str, ...]:
        """Those with a run."""
        return tuple(dict.fromkeys(arm.method for arm in self.arms))

    @property
    def runs(self) -> tuple[Run, ...]:
        """Of all arms."""
        return tuple(run for arm in self.arms for run in arm.runs)
