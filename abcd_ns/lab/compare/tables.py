"""The comparison as a table: a row per measure, a column per method."""

from pathlib import Path

from rich.console import Console

from abcd_ns.lab.compare.results import Results
from abcd_ns.lab.runs.tables import (
    MEASURES,
    about_machine,
    budget_of,
    cell,
    markdown,
    print_rows,
    seeds_in_words,
)


def rows(results: Results) -> list[list[str]]:
    """The table: titles first, then a row per measure."""
    titles = ["", *results.methods]
    return [titles, *([m.title, *(cell(results.of(x), m) for x in results.methods)] for m in MEASURES)]


def notes(results: Results) -> list[str]:
    """What a reader of the table has to know, a sentence each."""
    p = results.protocol
    budget, seeds = budget_of(p.seconds, p.steps), seeds_in_words(p.seeds)
    growth = "the number of Gaussians fixed" if not p.densify else ""
    limit = f"at most {p.max_gaussians:,} Gaussians" if p.max_gaussians else ""
    conditions = ", ".join(filter(None, [f"{budget} a run", seeds, growth, limit]))
    found = [
        f"Scene {p.scene} at 1/{p.downscale} of its size; held out: {p.held_out}; {conditions}.",
        about_machine(results.machine),
        "Evaluation, saving and compiling are left out of the training time.",
    ]
    reasons = {}
    for run in results.runs:
        reasons |= {"LPIPS": run.lpips_reason, "peak GPU memory": run.peak_device_note}
        if run.ordering_gap_note:
            found.append(f"{run.method}: no ordering gap ({run.ordering_gap_note}).")
    found += [f"{name} is missing: {reason}." for name, reason in reasons.items() if reason]
    found += [f"{left.method} is left out: {left.reason}." for left in results.left_out]
    found += [f"{f.method}, seed {f.seed} failed ({f.log}): {f.reason}" for f in results.failures]
    return list(dict.fromkeys(found))


def write_table(results: Results, path: Path) -> None:
    """The table as Markdown."""
    path.write_text(markdown(rows(results), notes(results)), encoding="utf-8")


def print_table(results: Results, console: Console) -> None:
    """The table in the terminal."""
    print_rows(rows(results), notes(results), console)
