"""`abcd doctor`: what this machine and environment are, whether they can train, and what to do where not."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from abcd_ns.cli.doctor import findings
from abcd_ns.cli.doctor.facts import Facts, gather, without_home
from abcd_ns.cli.doctor.hardware import Hardware
from abcd_ns.cli.doctor.kernels import Kernels
from abcd_ns.cli.findings import Finding, by_level, print_findings
from abcd_ns.cli.json_option import check_json, write_report

SCHEMA = 1
"""Of the JSON file; changes with its fields."""
CANNOT_TRAIN = 1
"""Exit code where something makes training impossible."""
UNKNOWN = "unknown, as torch does not start"


@dataclass(frozen=True)
class Report:
    """All that `abcd doctor` says. The user's home folder is written as ~."""

    schema: int
    facts: Facts
    findings: tuple[Finding, ...]
    """The most serious first."""


def doctor(*, json: Path | None = None) -> int:
    """Look at this machine and environment: versions, hardware, compiled kernels; and say what to mend.

    Compiles nothing, and writes nothing unless --json is given. What it prints is fit to be copied into an
    issue: it names no user and no folder of theirs. The exit code is 1 if training cannot work, else 0.

    Args:
        json: Also write what was found into this file.

    Raises:
        UserError: the JSON file cannot be written.
    """
    check_json(json)
    report = diagnose(gather())
    console = Console()
    for line in _lines(report.facts):
        console.print(line, markup=False, emoji=False, highlight=False, soft_wrap=True)
    print_findings(report.findings, console)
    ill = any(finding.level == "error" for finding in report.findings)
    verdict = "Training cannot work here yet: mend the errors." if ill else "Training can work here."
    console.print(f"\n{verdict}", highlight=False)
    write_report(json, report)
    return CANNOT_TRAIN if ill else 0


def diagnose(facts: Facts) -> Report:
    """What follows from the facts."""
    found = [finding for look in findings.ALL for finding in look(facts)]
    return without_home(Report(SCHEMA, facts, tuple(by_level(found))))


def _lines(facts: Facts) -> Iterator[str]:
    packages = facts.packages
    versions = {name: version or "not installed" for name, version in packages.versions.items()}
    commit = f", commit {packages.commit}" if packages.commit else ""
    rows = {
        "abcd_ns": f"{packages.abcd_ns}{commit}",
        "Python": packages.python,
        **versions,
        **(_hardware(facts.hardware) if facts.hardware else {"machine": UNKNOWN}),
        **(_kernels(facts.kernels) if facts.kernels else {"kernels": "unknown, as packages do not start"}),
    }
    width = max(map(len, rows))
    for name, value in rows.items():
        yield f"{name:<{width}}  {value}"


def _hardware(hardware: Hardware) -> dict[str, str]:
    gpu = hardware.gpu
    device = "none"
    if gpu is not None:
        device = f"{gpu.name}, {_gib(gpu.memory_bytes)}, capability {gpu.capability}"
    return {
        "OS": hardware.os,
        "CPU": f"{hardware.cpu}, {hardware.cores} cores",
        "RAM": f"{_gib(hardware.ram_bytes)}, {_gib(hardware.ram_free_bytes)} free",
        "disk": f"{_gib(hardware.disk_free_bytes)} free",
        "GPU": device,
        "driver": hardware.driver or "none",
        "torch's CUDA": hardware.torch_cuda or "none",
    }


def _kernels(kernels: Kernels) -> dict[str, str]:
    compilers = (
        kernels.compiler or "no C++ compiler",
        f"nvcc {kernels.nvcc}" if kernels.nvcc else "no nvcc",
        "ninja" if kernels.ninja else "no ninja",
    )
    checks = [f"{name} differs by {error:.0e}" for name, error in kernels.self_check.items()]
    checks += [f"{name} FAILED" for name in kernels.failed]
    return {
        "CPU kernels": f"{kernels.built} of {kernels.wanted} built, in {kernels.folder}",
        "gsplat's": kernels.gsplat or "not built",
        "compilers": ", ".join(compilers),
        "self-check": ", ".join(checks),
        "LPIPS": "no weights" if kernels.lpips_missing else "weights are there",
    }


def _gib(count: int) -> str:
    return f"{count / 2**30:.1f} GiB"
