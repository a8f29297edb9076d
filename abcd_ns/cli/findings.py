"""What `abcd check` and `abcd doctor` find: how serious, what it is, why it matters, what to do."""

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

from rich.console import Console

from abcd_ns.data.input_errors import one_line
from abcd_ns.terminal import print_plain

Level = Literal["error", "warning", "note"]
STYLES: dict[Level, str] = {"error": "bold red", "warning": "yellow", "note": "cyan"}
"""Of the levels' titles, the most serious first."""
SHOWN = 20  # findings of one level that are printed; the others are counted
WIDEST = 110  # columns at which text is wrapped at the latest


@dataclass(frozen=True)
class Finding:
    """One thing found."""

    level: Level  # error: nothing can come of it. warning: it may go wrong. note: good to know
    name: str  # its heading in docs/troubleshooting.md; stable
    what: str  # what was found and what follows from it
    fix: str = ""  # what to do about it; empty where there is nothing to be done


error, warning, note = (partial(Finding, level) for level in STYLES)


def print_findings(findings: Sequence[Finding], console: Console) -> None:
    """In groups by level, the most serious first. Errors stand in one line each, as `ns-train` has them."""
    for level, style in STYLES.items():
        group = [finding for finding in findings if finding.level == level]
        if group:
            title = level if len(group) == 1 else f"{level}s ({len(group)})"
            console.print(f"\n{title}", style=style, highlight=False)
        for finding in group[:SHOWN]:
            _print(finding, console)
        if len(group) > SHOWN:
            console.print(f"  ... and {len(group) - SHOWN} more ({len(group)} in all).", highlight=False)


def _print(finding: Finding, console: Console) -> None:
    # Names of files may hold newlines, and bytes that no terminal takes.
    what, fix = f"  {finding.name}: {one_line(finding.what)}", one_line(finding.fix)
    wide = {"width": min(console.width, WIDEST), "break_long_words": False, "break_on_hyphens": False}
    lines = [what] if finding.level == "error" else textwrap.wrap(what, subsequent_indent="    ", **wide)
    if fix:
        lines += textwrap.wrap(fix, initial_indent="    -> ", subsequent_indent="       ", **wide)
    print_plain("\n".join(lines), console)
