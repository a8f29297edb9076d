"""`abcd check`: look at a data set as training would, without training."""

import shlex
from pathlib import Path
from typing import Any

from rich.console import Console

from abcd_ns.cli.check.rules import doubts
from abcd_ns.cli.check.summary import print_summary, summarize
from abcd_ns.cli.check.survey import survey
from abcd_ns.cli.findings import Finding, by_level, error, note, print_findings, warning
from abcd_ns.cli.terminal import print_plain
from abcd_ns.data.input_errors import InputError, one_line
from abcd_ns.data.prepare import DOWNSCALE
from abcd_ns.lab.runs.options import check_ranges

REFUSED = 2
"""Exit code where training would refuse the data."""


def check(*, data: Path, downscale: int | None = None) -> int:
    """Examine a data set before training. Say what is wrong or doubtful, and what to do about it.

    abcd check --data garden

    Reads the data as `ns-train abcd` does, then decodes every photo. Writes nothing. The exit code is 2
    if training would refuse the data.

    Args:
        data: Folder with photos and a COLMAP model or a transforms.json, as for `ns-train abcd --data`.
        downscale: Divides the photos' width and height. Left out, no side is over 1600 px, as in training.
    """
    check_ranges({"downscale": downscale})
    summary, findings = examine(data, downscale)
    console, levels = Console(), {finding.level for finding in findings}
    if summary is not None:
        print_summary(summary, console)
    print_findings(findings, console)
    name, reduced = one_line(str(data)), f" {DOWNSCALE} {downscale}" if downscale else ""
    if "error" in levels:
        verdict = f"Training cannot work with {name}: fix the errors first."
    elif "warning" in levels:
        verdict = f"{name} can be trained on; see whether the warnings matter to you."
    else:
        verdict = f"{name} is fine: ns-train abcd --data {shlex.quote(name)}{reduced}"
    print_plain(f"\n{verdict}", console)
    return REFUSED if "error" in levels else 0


def examine(data: Path, downscale: int | None = None) -> tuple[dict[str, Any] | None, tuple[Finding, ...]]:
    """A summary, None where the data cannot be read, and what was found, the most serious first."""
    try:
        found = survey(data, downscale)
    except InputError as refused:
        return None, tuple(error("input", line) for line in refused.lines)
    own = [warning("input", said) for said in found.prepared.notes]
    own += [note("input", said) for said in found.prepared.chosen]
    return summarize(found), by_level([*own, *doubts(found)])
