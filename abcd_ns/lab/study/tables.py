"""A study as a table: a row per thing tried, a column per measure."""

from pathlib import Path

from rich.console import Console

from abcd_ns.lab.runs.tables import (
    MEASURES,
    NOTHING,
    about_machine,
    budget_of,
    cell,
    markdown,
    print_rows,
    seeds_in_words,
)
from abcd_ns.lab.study.findings import find_default, find_difference
from abcd_ns.lab.study.results import Arm, StudyResults

FIRST = {"blocks": "blocks", "gaussians": "limit", "options": "changed"}
"""The title of the first column, by study."""
QUALITY = ("PSNR, merged (dB)", "SSIM, merged", "PSNR, composited (dB)", "Gaussians", "steps", "training (s)")
MEMORY = ("peak RAM (GiB)", "peak GPU memory (GiB)")
SHOWN = {
    "blocks": (*QUALITY, *MEMORY),
    "gaussians": (*QUALITY, *MEMORY),
    "options": ("PSNR, merged (dB)", "SSIM, merged", "Gaussians", "steps", "training (s)"),
}
"""The titles of the measures, by study."""


def rows(results: StudyResults) -> list[list[str]]:
    """The table: titles first, then a row per arm. Columns in which nothing is known are left out."""
    by_title = {measure.title: measure for measure in MEASURES}
    measures = [
        by_title[title]
        for title in SHOWN[results.study]
        if any(cell(arm.runs, by_title[title]) != NOTHING for arm in results.arms)
    ]
    options, several = results.study == "options", len(results.methods) > 1
    titles = ["method"] * several + [FIRST[results.study]] + ["difference (dB)"] * options
    body = []
    for arm in results.arms:
        first = arm.variant if arm.value is None else f"{arm.value:,}"
        begin = [arm.method] * several + [first] + [_difference(arm, results)] * options
        body.append([*begin, *(cell(arm.runs, measure) for measure in measures)])
    return [[*titles, *(measure.title for measure in measures)], *body]


def notes(results: StudyResults) -> list[str]:
    """What a reader of the table has to know, a sentence each."""
    p = results.protocol
    conditions = [budget_of(p.seconds, p.steps) + " a run", seeds_in_words(p.seeds)]
    if len(results.methods) == 1:
        conditions.insert(0, results.methods[0])
    if results.study != "blocks" and set(results.methods) != {"abcd-monolithic"}:
        conditions.append(f"{p.blocks} blocks")
    if p.max_gaussians:
        conditions.append(f"at most {p.max_gaussians:,} Gaussians")
    found = [
        f"Scene {p.scene} at 1/{p.downscale} of its size; held out: {p.held_out}; {', '.join(conditions)}.",
        about_machine(results.machine),
        "Evaluation, saving and compiling are left out of the training time.",
    ]
    if len(p.seeds) > 1:
        found.append("Numbers are means over the seeds ± their standard deviation.")
    if results.study == "options":
        found.append("Differences are those of merged PSNR, taken seed by seed.")
    found += results.notes
    found += [
        f"{f.method}, {f.variant}, seed {f.seed} failed ({f.log}): {f.reason}" for f in results.failures
    ]
    return found


def write_table(results: StudyResults, path: Path) -> None:
    """What was found and the table, as Markdown."""
    found = "".join(f"{finding}\n\n" for finding in results.findings)
    path.write_text(found + markdown(rows(results), notes(results)), encoding="utf-8")


def print_table(results: StudyResults, console: Console) -> None:
    """The table in the terminal."""
    print_rows(rows(results), [*results.findings, *notes(results)], console)


def _difference(arm: Arm, results: StudyResults) -> str:
    default = find_default(results)
    found = None if default is None or arm is default else find_difference(arm, default)
    if found is None:
        return NOTHING
    return f"{found.mean:+.2f}" + ("" if found.deviation is None else f" ± {found.deviation:.2f}")
