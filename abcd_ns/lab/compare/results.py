"""results.json: everything a comparison found, with what is needed to do it again."""

from dataclasses import dataclass
from pathlib import Path

from abcd_ns.lab.runs.records import encode, read_record, write_json
from abcd_ns.lab.runs.run import Failure, Run
from abcd_ns.nerfstudio.machine import Machine, Versions

SCHEMA = 1
"""Raised whenever a field changes its name or meaning."""


@dataclass(frozen=True)
class Protocol:
    """Everything that defines the comparison."""

    scene: str
    downscale: int
    held_out: str
    seconds: float | None
    steps: int | None
    methods: tuple[str, ...]
    seeds: tuple[int, ...]
    blocks: int
    evals: int
    max_gaussians: int
    densify: bool
    pictures: int
    date: str
    """When the comparison was finished: ISO 8601, UTC."""
    command: str


@dataclass(frozen=True)
class LeftOut:
    """A method that was asked for and cannot run here."""

    method: str
    reason: str


@dataclass(frozen=True)
class Results:
    """The whole of results.json."""

    schema: int
    protocol: Protocol
    machine: Machine
    versions: Versions
    runs: tuple[Run, ...]
    failures: tuple[Failure, ...] = ()
    left_out: tuple[LeftOut, ...] = ()

    def of(self, method: str) -> tuple[Run, ...]:
        """The method's runs, one per seed."""
        return tuple(run for run in self.runs if run.method == method)

    @property
    def methods(self) -> tuple[str, ...]:
        """Those with at least one run, in the protocol's order."""
        return tuple(method for method in self.protocol.methods if self.of(method))


def write_results(path: Path, results: Results) -> None:
    """Write results.json.

    Raises:
        ValueError: a number is NaN or infinite.
    """
    write_json(path, encode(results))


def read_results(path: Path) -> Results:
    """Read results.json back.

    Raises:
        RecordError: it is absent, of another schema, or does not fit the schema.
    """
    return read_record(path, Results, SCHEMA)
