"""`abcd check`: look at a data set as training would, without training."""

import shlex
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from abcd_ns.cli.check import about_cameras, about_photos, about_points
from abcd_ns.cli.check.summary import Summary, print_summary, summarize
from abcd_ns.cli.check.survey import Survey, survey
from abcd_ns.cli.findings import Finding, by_level, check_json, print_findings, write_report
from abcd_ns.cli.terminal import print_plain
from abcd_ns.data.input_errors import InputError, one_line
from abcd_ns.data.prepare import DOWNSCALE
from abcd_ns.errors import UserError

SCHEMA = 1
"""Of the JSON file; changes with its fields."""
REFUSED = 2
"""Exit code where training would refuse the data."""


@dataclass(frozen=True)
class Report:
    """All that `abcd check` says."""

    schema: int
    data: str
    downscale: int | None
    """As asked for; None leaves it to training."""
    summary: Summary | None
    """None where the data cannot be read."""
    findings: tuple[Finding, ...]
    """The most serious first."""

    @property
    def refused(self) -> bool:
        """Whether training would refuse the data, or stop at them."""
        return any(finding.level == "error" for finding in self.findings)


def check(*, data: Path, downscale: int | None = None, json: Path | None = None) -> int:
    """Examine a data set without training, and explain what is wrong or doubtful with it.

    Reads it as `ns-train abcd` does and refuses what that refuses, in the same words; then decodes every
    photo. Writes nothing unless --json is given. Exit code: 2 if training would refuse the data or stop at
    them, else 0.

    Args:
        data: Folder with a COLMAP model or a transforms.json, and photos; as for `ns-train abcd --data`.
        downscale: Divides the photos' width and height, as training's downscale-factor. Left out, no side is
            over 1600 px, as in training.
        json: Also write what was found into this file.

    Raises:
        UserError: an option is out of range, or the JSON file cannot be written.
    """
    if downscale is not None and downscale < 1:
        raise UserError(f"--downscale is {downscale}; it must be a whole number from 1.")
    check_json(json)
    report = examine(data, downscale)
    console = Console()
    if report.summary is not None:
        print_summary(report.summary, console)
    print_findings(report.findings, console)
    print_plain(_verdict(report), console)
    write_report(json, report)
    return REFUSED if report.refused else 0


def examine(data: Path, downscale: int | None = None) -> Report:
    """Everything that can be said of a data set."""
    try:
        found = survey(data, downscale)
    except InputError as error:
        refusals = tuple(Finding("error", "input", line) for line in error.lines)
        return Report(SCHEMA, str(data), downscale, None, refusals)
    return Report(SCHEMA, str(data), downscale, summarize(found), tuple(by_level(findings_of(found))))


def findings_of(found: Survey) -> list[Finding]:
    """What is wrong or doubtful with a scene that can be read: the reader's own notes, then all others."""
    findings = [Finding("warning", "input", note) for note in found.prepared.notes]
    findings += [Finding("note", "input", note) for note in found.prepared.chosen]
    for look in (*about_photos.ALL, *about_cameras.ALL, *about_points.ALL):
        findings.extend(look(found))
    return findings


def _verdict(report: Report) -> str:
    data = one_line(report.data)
    if report.refused:
        return f"\nTraining cannot work with {data}: mend the errors first."
    if any(finding.level == "warning" for finding in report.findings):
        return f"\n{data} can be trained on; see whether the warnings matter to you."
    reduced = f" {DOWNSCALE} {report.downscale}" if report.downscale else ""
    return f"\n{data} is fine: ns-train abcd --data {shlex.quote(data)}{reduced}"
