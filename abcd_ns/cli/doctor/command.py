"""`abcd doctor`: what this machine and environment are, whether they can train, and what to do where not."""

import json as json_text
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from abcd_ns.cli.doctor.facts import Facts, gather
from abcd_ns.cli.doctor.hardware import Hardware
from abcd_ns.cli.doctor.kernels import Kernels
from abcd_ns.cli.doctor.packages import VERSIONS
from abcd_ns.cli.doctor.rules import RULES
from abcd_ns.cli.findings import Finding, by_level, check_json, judge, print_findings, write_report
from abcd_ns.cli.terminal import many, print_plain
from abcd_ns.lab.results.records import decode, encode
from abcd_ns.machine import without_home
from abcd_ns.units import bytes_in_words

SCHEMA = 1
"""Of the JSON file; changes with its fields."""
CANNOT_TRAIN = 1
"""Exit code where something makes training impossible."""
MAIN = ("torch", "nerfstudio", "gsplat", "viser")
"""Packages whose versions are always shown."""
DETAILS = {*VERSIONS, "OS", "driver", "torch's CUDA", "compilers", "LPIPS"}
"""Rows that only --verbose shows."""


@dataclass(frozen=True)
class Report:
    """All that `abcd doctor` says. The user's home folder is written as ~."""

    schema: int
    facts: Facts
    findings: tuple[Finding, ...]
    """The most serious first."""


def doctor(*, json: Path | None = None, verbose: bool = False) -> int:
    """Look at this machine and environment: versions, hardware, compiled kernels; and say what to fix.

    Compiles nothing, and writes nothing unless --json is given. What it prints is fit to be copied into an
    issue: it names no user and no folder of theirs. The exit code is 1 if training cannot work, else 0.

    Args:
        json: Also write all that was found into this file.
        verbose: Show all of it here too, notes included.

    Raises:
        UserError: the JSON file cannot be written.
    """
    check_json(json)
    report = diagnose(gather())
    console = Console()
    rows = {name: value for name, value in _rows(report.facts).items() if verbose or name not in DETAILS}
    width = max(map(len, rows))
    for name, value in rows.items():
        print_plain(f"{name:<{width}}  {value}", console)
    shown = [finding for finding in report.findings if verbose or finding.level != "note"]
    print_findings(shown, console)
    ill = any(finding.level == "error" for finding in report.findings)
    verdict = "Training cannot work here yet: fix the errors." if ill else "Training can work here."
    if not verbose:
        left = len(report.findings) - len(shown)
        notes = f" and {many(left, 'note', 'notes')}" if left else ""
        verdict += f" All versions{notes}: abcd doctor --verbose"
    console.print(f"\n{verdict}", highlight=False)
    write_report(json, report)
    return CANNOT_TRAIN if ill else 0


def diagnose(facts: Facts) -> Report:
    """What follows from the facts."""
    report = Report(SCHEMA, facts, by_level(judge(RULES, facts)))
    return decode(Report, json_text.loads(without_home(json_text.dumps(encode(report)))), "the report")


def _rows(facts: Facts) -> dict[str, str]:
    """All there is to show."""
    packages, hardware, kernels = facts.packages, facts.hardware, facts.kernels
    number, plus, changes = (packages.commit or "").partition("+")
    commit = f", commit {number[:10]}{plus}{changes}" if number else ""
    versions = {name: version or "not installed" for name, version in packages.versions.items()}
    rows = {
        "abcd_ns": f"{packages.abcd_ns}{commit}; Python {packages.python}",
        "packages": ", ".join(f"{name} {versions.get(name)}" for name in MAIN),
        **{name: version for name, version in versions.items() if name not in MAIN},
    }
    rows |= _hardware(hardware, packages.ray) if hardware else {"machine": "unknown, as torch does not start"}
    return rows | (_kernels(kernels) if kernels else {"kernels": "unknown, as packages do not start"})


def _hardware(hardware: Hardware, ray: str | None) -> dict[str, str]:
    gpu, device = hardware.gpu, "none: training runs on the CPU, which is meant for small pictures"
    most, workers = hardware.cores, f"up to {hardware.cores}, one for each core, for two blocks each"
    if gpu is not None:
        device = f"{gpu.name}, {bytes_in_words(gpu.memory_bytes)}, capability {gpu.capability}"
        how = f"by Ray {ray}" if ray else "after pip install 'abcd-ns[cluster]'"
        most, workers = hardware.gpus, f"up to {hardware.gpus}, one for each GPU: --pipeline.workers, {how}"
    return {
        "GPU": device,
        "CPU": f"{hardware.cpu}, {hardware.cores} cores",
        "RAM": f"{bytes_in_words(hardware.ram_bytes)}, {bytes_in_words(hardware.ram_free_bytes)} free",
        "disk": f"{bytes_in_words(hardware.disk_free_bytes)} free",
        "OS": hardware.os,
        "driver": hardware.driver or "none",
        "torch's CUDA": hardware.torch_cuda or "none",
        "workers": workers if most > 1 else f"none here: one {'GPU' if gpu else 'core'}",
    }


def _kernels(kernels: Kernels) -> dict[str, str]:
    checks = [f"{name} differs by {error:.0e}" for name, error in kernels.self_check.items()]
    tools = (
        kernels.compiler or "no C++ compiler",
        f"nvcc {kernels.nvcc}" if kernels.nvcc else "no nvcc",
        "ninja" if kernels.ninja else "no ninja",
    )
    return {
        "CPU rasterizer": f"compiled, in {kernels.folder}" if kernels.built else "first use compiles it",
        "gsplat's": kernels.gsplat or "not built",
        "self-check": ", ".join([*checks, *(f"{name} FAILED" for name in kernels.failed)]),
        "compilers": ", ".join(tools),
        "LPIPS": "no weights" if kernels.lpips_missing else "weights are there",
    }
