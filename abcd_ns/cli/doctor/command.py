"""`abcd doctor`: what this machine and environment are, whether they can train, and what to do where not."""

import json as json_text
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from abcd_ns.cli.doctor.facts import Facts, gather
from abcd_ns.cli.doctor.hardware import Hardware
from abcd_ns.cli.doctor.kernels import Kernels
from abcd_ns.cli.doctor.packages import Packages
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
    console, rows = Console(), _rows(report.facts, verbose)
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


def _rows(facts: Facts, verbose: bool) -> dict[str, str]:
    packages, hardware, kernels = facts.packages, facts.hardware, facts.kernels
    rows = _packages(packages, verbose)
    if hardware is None:
        rows["machine"] = "unknown, as torch does not start"
    else:
        rows |= _hardware(hardware, verbose) | {"workers": _workers(hardware, packages.ray)}
    if kernels is None:
        return rows | {"kernels": "unknown, as packages do not start"}
    return rows | _kernels(kernels, hardware.gpu is not None, verbose)


def _packages(packages: Packages, verbose: bool) -> dict[str, str]:
    number, plus, changes = (packages.commit or "").partition("+")
    commit = f", commit {number[:10]}{plus}{changes}" if number else ""
    names = packages.versions if verbose else MAIN
    versions = {name: packages.versions.get(name) or "not installed" for name in names}
    listed = {"packages": ", ".join(f"{name} {version}" for name, version in versions.items())}
    own = {"abcd_ns": f"{packages.abcd_ns}{commit}; Python {packages.python}"}
    return own | (versions if verbose else listed)


def _hardware(hardware: Hardware, verbose: bool) -> dict[str, str]:
    gpu, device = hardware.gpu, "none: training runs on the CPU, which is meant for small pictures"
    if gpu is not None:
        device = f"{gpu.name}, {bytes_in_words(gpu.memory_bytes)}, capability {gpu.capability}"
    rows = {
        "GPU": device,
        "CPU": f"{hardware.cpu}, {hardware.cores} cores",
        "RAM": f"{bytes_in_words(hardware.ram_bytes)}, {bytes_in_words(hardware.ram_free_bytes)} free",
        "disk": f"{bytes_in_words(hardware.disk_free_bytes)} free",
    }
    cuda = {"driver": hardware.driver or "none", "torch's CUDA": hardware.torch_cuda or "none"}
    return rows | ({"OS": hardware.os} | cuda if verbose else {})


def _workers(hardware: Hardware, ray: str | None) -> str:
    """How many blocks could be trained at once."""
    most, of = (hardware.gpus, "GPU") if hardware.gpu else (hardware.cores, "core")
    if most < 2:
        return f"none here: one {of}"
    if not hardware.gpu:
        return f"up to {most}, one for each core, where a scene has two blocks for each"
    how = f"by Ray {ray}" if ray else "after pip install 'abcd-ns[cluster]'"
    return f"up to {most}, one for each GPU: --pipeline.workers, {how}"


def _kernels(kernels: Kernels, on_gpu: bool, verbose: bool) -> dict[str, str]:
    checks = [f"{name} differs by {error:.0e}" for name, error in kernels.self_check.items()]
    checks += [f"{name} FAILED" for name in kernels.failed]
    built = "compiled" if kernels.built else "not compiled"
    if not kernels.built and not on_gpu:
        built += ": the first use compiles it, in some 15 seconds"
    rows = {"CPU rasterizer": f"{built}, in {kernels.folder}" if verbose else built}
    if verbose or on_gpu:
        rows["gsplat's"] = kernels.gsplat or "not built: the first training or `abcd plan` compiles them"
    rows["self-check"] = ", ".join(checks)
    if verbose:
        nvcc = f"nvcc {kernels.nvcc}" if kernels.nvcc else "no nvcc"
        ninja = "ninja" if kernels.ninja else "no ninja"
        rows["compilers"] = f"{kernels.compiler or 'no C++ compiler'}, {nvcc}, {ninja}"
        rows["LPIPS"] = "no weights" if kernels.lpips_missing else "weights are there"
    return rows
