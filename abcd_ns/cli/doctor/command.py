"""`abcd doctor`: what this machine and environment are, whether they can train, and what to do where not."""

from dataclasses import replace

from rich.console import Console

from abcd_ns.cli.doctor.facts import Facts, gather
from abcd_ns.cli.doctor.rules import findings_of
from abcd_ns.cli.findings import Finding, by_level, print_findings
from abcd_ns.cli.terminal import many, print_facts
from abcd_ns.machine import without_home
from abcd_ns.units import bytes_in_words

CANNOT_TRAIN = 1
"""Exit code where something makes training impossible."""
MAIN = ("torch", "nerfstudio", "gsplat", "viser")
"""Packages whose versions are always shown."""
DETAILS = ("os", "driver", "torch_cuda", "lpips_missing")
"""Facts that only --verbose shows, beside the other packages' versions."""


def doctor(*, verbose: bool = False) -> int:
    """Examine this machine: versions, hardware, compiled kernels. Say what to fix.

    Compiles nothing and writes nothing. The output names no user and no home folder, so that it can be copied
    into an issue. The exit code is 1 if training cannot work.

    Args:
        verbose: Show all versions and notes.
    """
    facts, console = gather(), Console()
    findings = diagnose(facts)
    details = facts.versions | facts.build_tools | {name: getattr(facts, name) for name in DETAILS}
    more = {name.replace("_", " "): value or "none" for name, value in details.items() if verbose}
    print_facts({name: without_home(value) for name, value in (_rows(facts) | more).items()}, console)
    shown = [finding for finding in findings if verbose or finding.level != "note"]
    print_findings(shown, console)
    ill = any(finding.level == "error" for finding in findings)
    verdict = "Training cannot work here yet: fix the errors." if ill else "Training can work here."
    if not verbose:
        left = len(findings) - len(shown)
        notes = f" and {many(left, 'note', 'notes')}" if left else ""
        verdict += f" All versions{notes}: abcd doctor --verbose"
    console.print(f"\n{verdict}", highlight=False)
    return CANNOT_TRAIN if ill else 0


def diagnose(facts: Facts) -> tuple[Finding, ...]:
    """What follows from the facts, the most serious first."""
    found = findings_of(facts)
    return by_level(replace(f, what=without_home(f.what), fix=without_home(f.fix)) for f in found)


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
