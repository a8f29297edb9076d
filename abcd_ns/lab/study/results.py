"""results.json of a study: every run, and what is needed to make them again."""

from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

from abcd_ns.lab.runs.records import encode, read_record, write_json
from abcd_ns.lab.runs.run import Failure, Run
from abcd_ns.nerfstudio.machine import Machine, Versions

SCHEMA = 1
"""Raised whenever a field changes its name or meaning."""


@dataclass(frozen=True)
class Arm:
    """One method with one thing set, and its runs."""

    method: str
    variant: str
    """What is set: `blocks=4`, or "default"."""
    value: int | None
    """The number of blocks or the limit on Gaussians; None in a study of options."""
    runs: tuple[Run, ...]
    """One for each seed that did not fail."""

    @property
    def psnr(self) -> float:
        """Held out, merged, dB; mean over the seeds."""
        return fmean(run.psnr_merged for run in self.runs)

    @property
    def gaussians(self) -> float:
        """At the end, mean over the seeds."""
        return fmean(run.gaussians for run in self.runs)


@dataclass(frozen=True)
class StudyProtocol:
    """Everything that defines the study."""

    scene: str
    downscale: int
    held_out: str
    seconds: float | None
    steps: int | None
    methods: tuple[str, ...]
    varied: tuple[str, ...]
    seeds: tuple[int, ...]
    blocks: int
    """Unless it is what is varied. Likewise `max_gaussians`."""
    evals: int
    max_gaussians: int
    date: str
    """When the study was finished: ISO 8601, UTC."""
    command: str


@dataclass(frozen=True)
class StudyResults:
    """The whole of results.json."""

    schema: int
    study: str
    protocol: StudyProtocol
    machine: Machine
    versions: Versions
    arms: tuple[Arm, ...]
    """Those with a run."""
    failures: tuple[Failure, ...] = ()
    findings: tuple[str, ...] = ()
    """What the study says, a sentence each."""
    notes: tuple[str, ...] = ()

    def of(self, method: str) -> tuple[Arm, ...]:
        """The method's arms, in their order."""
        return tuple(arm for arm in self.arms if arm.method == method)

    @property
    def methods(self) -> tuple[str, ...]:
        """Those with a run."""
        return tuple(method for method in self.protocol.methods if self.of(method))


def write_study(path: Path, results: StudyResults) -> None:
    """Write results.json.

    Raises:
        ValueError: a number is NaN or infinite.
    """
    write_json(path, encode(results))


def read_study(path: Path) -> StudyResults:
    """Read results.json back.

    Raises:
        RecordError: it is absent, of another schema, or does not fit the schema.
    """
    return read_record(path, StudyResults, SCHEMA)
