"""`abcd check`: look at a data set as training would, without training."""

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from abcd_ns.cli.check.rules import doubts
from abcd_ns.cli.check.summary import print_summary, summarize
from abcd_ns.cli.check.survey import Survey, survey
from abcd_ns.cli.findings import Finding, by_level, check_json, print_findings, write_report
from abcd_ns.cli.terminal import print_plain
from abcd_ns.data.input_errors import InputError, one_line
from abcd_ns.data.prepare import DOWNSCALE
from abcd_ns.errors import UserError

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

    Raises:
        UserError: an option is out of range, or the JSON file cannot be written.
    """
    if downscale is not None and downscale < 1:
        raise UserError(f"--downscale is {downscale}; it must be a whole number from 1.")
    check_json(json)
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
    write_report(json, report)
    return REFUSED if "error" in levels else 0


def examine(data: Path, downscale: int | None = None) -> Report:
    """Everything that can be said of a data set."""
    try:
        found = survey(data, downscale)
    except InputError as error:
        refusals = tuple(Finding("error", "input", line) for line in error.lines)
        return Report(SCHEMA, str(data), downscale, None, refusals)
    return Report(SCHEMA, str(data), downscale, summarize(found), by_level(findings_of(found)))


def findings_of(found: Survey) -> list[Finding]:
    """What is wrong or doubtful with a scene that can be read: the reader's own notes, then all others."""
    findings = [Finding("warning", "input", note) for note in found.prepared.notes]
    findings += [Finding("note", "input", note) for note in found.prepared.chosen]
    return [*findings, *doubts(found)]
