"""`abcd doctor`: what this machine and environment are, whether they can train, and what to do where not."""

import json as json_text
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from abcd_ns.cli.doctor.facts import Facts, gather
from abcd_ns.cli.doctor.rules import findings_of
from abcd_ns.cli.findings import Finding, by_level, print_findings
from abcd_ns.cli.paths import check_file
from abcd_ns.cli.terminal import many, print_facts
from abcd_ns.lab.results.records import decode, encode, write_json
from abcd_ns.machine import without_home
from abcd_ns.units import bytes_in_words

SCHEMA = 3
"""Of the JSON file; changes with its fields."""
CANNOT_TRAIN = 1
"""Exit code where something makes training impossible."""
MAIN = ("torch", "nerfstudio", "gsplat", "viser")
"""Packages whose versions are always shown."""
DETAILS = ("os", "driver", "torch_cuda", "lpips_missing")
"""Facts that only --verbose shows, beside the other packages' versions."""


@dataclass(frozen=True)
class Report:
    """All that `abcd doctor` says. The user's home folder is written as ~."""

    schema: int
    facts: Facts
    findings: tuple[Finding, ...]
    """The most serious first."""


def doctor(*, json: Path | None = None, verbose: bool = False) -> int:
    """Examine this machine: versions, hardware, compiled kernels. Say what to fix.

    Compiles nothing and writes nothing unless --json is given. The output names no user and no home folder,
    so that it can be copied into an issue. The exit code is 1 if training cannot work.

    Args:
        json: Also write everything that was found into this file.
        verbose: Show all versions and notes.
    """
    if json is not None:
        check_file("--json", json)
    report = diagnose(gather())
    facts, console = report.facts, Console()
    details = facts.versions | facts.build_tools | {name: getattr(facts, name) for name in DETAILS}
    more = {name.replace("_", " "): value or "none" for name, value in details.items() if verbose}
    print_facts(_rows(facts) | more, console)
    shown = [finding for finding in report.findings if verbose or finding.level != "note"]
    print_findings(shown, console)
    ill = any(finding.level == "error" for finding in report.findings)
    verdict = "Training cannot work here yet: fix the errors." if ill else "Training can work here."
    if not verbose:
        left = len(report.findings) - len(shown)
        notes = f" and {many(left, 'note', 'notes')}" if left else ""
        verdict += f" All versions{notes}: abcd doctor --verbose"
    console.print(f"\n{verdict}", highlight=False)
    if json is not None:
        write_json(json, encode(report))
    return CANNOT_TRAIN if ill else 0


def diagnose(facts: Facts) -> Report:
    """What follows from the facts."""
    report = Report(SCHEMA, facts, by_level(findings_of(facts)))
    return decode(Report, json_text.loads(without_home(json_text.dumps(encode(report)))), "the report")


def _rows(f: Facts) -> dict[str, str]:
    """What is always shown."""
    rows = {
        "abcd_ns": f"{f.abcd_ns}; Python {f.python}",
        "packages": ", ".join(f"{name} {f.versions.get(name) or 'not installed'}" for name in MAIN),
        "GPU": f.gpu or "none: training runs on the CPU, which is meant for small pictures",
        "CPU": f"{f.cpu}, {f.cores} cores" if f.cpu else "unknown, as torch does not start",
        "RAM": f"{bytes_in_words(f.ram_bytes)}, {bytes_in_words(f.ram_free_bytes)} free",
        "disk": f"{bytes_in_words(f.disk_free_bytes)} free",
        "workers": _workers(f),
    }
    if f.folder is None:
        return rows | {"kernels": "unknown, as packages do not start"}
    checked = "FAILED" if f.difference is None else f"differs by {f.difference:.0e} from the reference"
    return rows | {
        "CPU rasterizer": f"compiled, in {f.folder}" if f.built else "first use compiles it, in 15 s",
        "gsplat's": f.gsplat or "not built",
        "self-check": checked,
    }


def _workers(f: Facts) -> str:
    """How many blocks could be trained at once."""
    if f.gpu and f.gpus > 1:
        how = f"by Ray {f.ray}" if f.ray else "after pip install 'abcd-ns[cluster]'"
        return f"up to {f.gpus}, one for each GPU: ns-train's --pipeline.workers, {how}"
    if f.gpu or f.cores < 2:
        return f"none here: one {'GPU' if f.gpu else 'core'}"
    return f"up to {f.cores}, one for each core, for two blocks each"
