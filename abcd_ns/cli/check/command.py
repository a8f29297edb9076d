"""`abcd check`: look at a data set as training would, without training."""

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from abcd_ns.cli.check.rules import doubts
from abcd_ns.cli.check.summary import print_summary, summarize
from abcd_ns.cli.check.survey import survey
from abcd_ns.cli.findings import Finding, by_level, error, note, print_findings, warning
from abcd_ns.cli.paths import check_file
from abcd_ns.cli.terminal import print_plain
from abcd_ns.data.input_errors import InputError, one_line
from abcd_ns.data.prepare import DOWNSCALE
from abcd_ns.lab.results.records import encode, write_json
from abcd_ns.lab.runs.options import check_ranges

SCHEMA = 2
"""Of the JSON file; changes with its fields."""
REFUSED = 2
"""Exit code where training would refuse the data."""


@dataclass(frozen=True)
class Report:
    """All that `abcd check` says."""

    schema: int
    data: str
    downscale: int | None
    """The option; None leaves it to training."""
    summary: dict[str, Any] | None
    """None where the data cannot be read."""
    findings: tuple[Finding, ...]
    """The most serious first."""


def check(*, data: Path, downscale: int | None = None, json: Path | None = None) -> int:
    """Examine a data set before training. Say what is wrong or doubtful, and what to do about it.

    abcd check --data garden

    Reads the data as `ns-train abcd` does, then decodes every photo. Writes nothing unless --json is given.
    The exit code is 2 if training would refuse the data.

    Args:
        data: Folder with photos and a COLMAP model or a transforms.json, as for `ns-train abcd --data`.
        downscale: Divides the photos' width and height. Left out, no side is over 1600 px, as in training.
        json: Also write what was found into this file.
    """
    check_ranges({"downscale": downscale})
    if json is not None:
        check_file("--json", json)
    report = examine(data, downscale)
    console, levels = Console(), {finding.level for finding in report.findings}
    if report.summary is not None:
        print_summary(report.summary, console)
    print_findings(report.findings, console)
    name, reduced = one_line(report.data), f" {DOWNSCALE} {downscale}" if downscale else ""
    if "error" in levels:
        verdict = f"Training cannot work with {name}: fix the errors first."
    elif "warning" in levels:
        verdict = f"{name} can be trained on; see whether the warnings matter to you."
    else:
        verdict = f"{name} is fine: ns-train abcd --data {shlex.quote(name)}{reduced}"
    print_plain(f"\n{verdict}", console)
    if json is not None:
        write_json(json, encode(report))
    return REFUSED if "error" in levels else 0


def examine(data: Path, downscale: int | None = None) -> Report:
    """Everything that can be said of a data set."""
    try:
        found = survey(data, downscale)
    except InputError as refused:
        refusals = tuple(error("input", line) for line in refused.lines)
        return Report(SCHEMA, str(data), downscale, None, refusals)
    own = [warning("input", said) for said in found.prepared.notes]
    own += [note("input", said) for said in found.prepared.chosen]
    return Report(SCHEMA, str(data), downscale, summarize(found), by_level([*own, *doubts(found)]))
