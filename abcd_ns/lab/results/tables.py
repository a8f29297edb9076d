"""Results in words: what they say, a sentence each, and as tables, with how many digits."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from statistics import fmean, stdev

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.measure import Measurement
from rich.table import Table

from abcd_ns.lab.job import AS_IT_IS, HELD_OUT_EVERY
from abcd_ns.lab.results.results import TERRAIN, Arm, Outcome, Results, Run
from abcd_ns.machine import Machine
from abcd_ns.terminal import many, print_plain
from abcd_ns.units import GIB, MIB

TABLE_FILE = "table.md"
NOTHING = "-"  # stands where there is no value
NEAR_DB = 0.2  # how far below the best fewer Gaussians may be and still count as enough
GOAL_GROWTH = 0.05  # growth of peak memory that is allowed from the smallest terrain to the largest
MOST_COLUMNS = 5  # arms that stand beside each other; more stand below each other
Rows = list[list[str]]  # of a table, its titles first


@dataclass(frozen=True)
class Measure:
    """One row or column."""

    title: str  # with its unit
    field: str  # of `Run`; after a dot, of a part of it
    digits: int
    unit: int = 1


MEASURES = (
    Measure("PSNR, composited (dB)", "psnr", 2),
    Measure("SSIM, composited", "ssim", 3),
    Measure("LPIPS, composited", "lpips", 3),
    Measure("PSNR, merged (dB)", "psnr_merged", 2),
    Measure("SSIM, merged", "ssim_merged", 3),
    Measure("ordering gap (dB)", "ordering_gap_db", 1),
    Measure("Gaussians", "gaussians", 0),
    Measure("parameters", "parameters", 0),
    Measure("visible Gaussians as .ply (MiB)", "ply_bytes", 2, MIB),
    Measure("visible Gaussians as .spz (MiB)", "spz_bytes", 2, MIB),
    Measure("blocks", "blocks", 0),
    Measure("steps", "steps", 0),
    Measure("training (s)", "train_seconds", 1),
    Measure("of it, layers (s)", "layer_seconds", 1),
    Measure("whole process (s)", "total_seconds", 1),
    Measure("peak GPU memory (GiB)", "peak_device_bytes", 2, GIB),
    Measure("peak GPU memory, reserved (GiB)", "peak_reserved_bytes", 2, GIB),
    Measure("peak of Gaussians (MiB)", "gaussian_bytes", 2, MIB),
    Measure("peak RAM (GiB)", "peak_rss_bytes", 2, GIB),
    Measure("blocks on disk (MiB)", "store_bytes", 1, MIB),
    Measure("visit (s)", "memory.visit_seconds", 1),
    Measure("of a visit, layers (s)", "memory.layer_seconds", 1),
)
"""Of an arm."""


def findings_of(results: Results) -> tuple[str, ...]:
    """Best and worst arm of each method, or the growth of memory, or the scenarios that pass."""
    if results.outcomes:
        return (headline(results.outcomes),)
    if results.kind == TERRAIN:
        return _of_growth(results)
    several = (arms for arms in map(results.of, results.methods) if len(arms) > 1)
    return tuple(_of_arms(arms, results.labels) for arms in several)


def headline(outcomes: Sequence[Outcome]) -> str:
    """One sentence about all scenarios."""
    failed = ", ".join(outcome.id for outcome in outcomes if not outcome.passed)
    worse = ", ".join(outcome.id for outcome in outcomes if outcome.worse)
    text = f"{sum(outcome.passed for outcome in outcomes)} of {len(outcomes)} scenarios pass"
    text += f"; these fail: {failed}" if failed else ""
    return text + (f"; one block does better, by however little, in {worse}." if worse else ".")


def _of_arms(arms: Sequence[Arm], labels: Mapping[str, str]) -> str:
    psnrs = {arm.name: arm.mean("psnr_merged") for arm in arms}
    best, worst = max(psnrs, key=psnrs.get), min(psnrs, key=psnrs.get)
    enough = [arm for arm in arms if psnrs[best] - psnrs[arm.name] <= NEAR_DB]
    fewest = min(enough, key=lambda arm: arm.mean("gaussians"))
    return (
        f"Best: {labels[best]}, {psnrs[best]:.2f} dB. Worst: {labels[worst]}, {psnrs[worst]:.2f} dB. "
        f"Gap: {psnrs[best] - psnrs[worst]:.2f} dB. Fewest Gaussians within {NEAR_DB:g} dB of the best: "
        f"{fewest.mean('gaussians'):,.0f} ({labels[fewest.name]}, {psnrs[fewest.name]:.2f} dB)."
    )


def _of_growth(results: Results) -> tuple[str, ...]:
    """Of ABCD's peak memory, from the smallest terrain to the largest."""
    arms, said = results.of("abcd"), []
    if len(arms) < 2:
        return ()
    for name, field in (("peak RAM grows", "peak_rss_bytes"), ("GPU memory", "peak_device_bytes")):
        sizes = [getattr(arm.runs[0], field) for arm in arms]
        said += [f"{name} by {sizes[-1] / sizes[0] - 1:.1%}"] if all(sizes) else []
    grown = f"From {arms[0].value} to {arms[-1].value} blocks of ABCD, {', '.join(said)}"
    return (f"{grown}; allowed: {GOAL_GROWTH:.0%}.",)


def cell(runs: Sequence[Run], measure: Measure) -> str:
    """The measure of an arm's runs: a number, or mean and standard deviation over the seeds (n - 1)."""
    parts = measure.field.split(".")
    values = [reduce(lambda record, name: getattr(record, name, None), parts, run) for run in runs]
    if None in values:
        return NOTHING
    return mean_of([value / measure.unit for value in values], f",.{measure.digits}f")


def mean_of(values: Sequence[float], form: str) -> str:
    """Mean and standard deviation (n - 1), the latter of several values only, in a format of Python's."""
    if not values:
        return NOTHING
    deviation = "" if len(values) == 1 else f" ± {stdev(values):{form.lstrip('+')}}"
    return f"{fmean(values):{form}}{deviation}"


def rows(results: Results) -> Rows:
    """A column for each arm, or a row where there are many. What nobody knows is left out."""
    table = [["", *(arm.name for arm in results.arms)]]
    for measure in MEASURES:
        if measure.field == "psnr" and results.settings is None:
            continue  # of crops that were trained on
        table.append([measure.title, *(cell(arm.runs, measure) for arm in results.arms)])
        if measure.field == "psnr_merged":
            table.append(["difference (dB)", *(_difference(arm, results) for arm in results.arms)])
            table.append(["worst view (dB)", *(_worst_view(arm, results) for arm in results.arms)])
    table = [row for row in table if set(row[1:]) != {NOTHING}]
    many = len(results.arms) > MOST_COLUMNS
    return [list(column) for column in zip(*table, strict=True)] if many else table


def _pairs(arm: Arm, other: Arm | None) -> list[tuple[Run, Run]]:
    """Runs of both on the same seeds."""
    theirs = {run.seed: run for run in other.runs} if other else {}
    return [(run, theirs[run.seed]) for run in arm.runs if run.seed in theirs]


def _difference(arm: Arm, results: Results) -> str:
    """Of merged PSNR to the arm without changes, over the seeds that both have."""
    pairs = _pairs(arm, results.baseline(arm)) if results.settings else []
    return mean_of([ours.psnr_merged - theirs.psnr_merged for ours, theirs in pairs], "+.2f")


def _worst_view(arm: Arm, results: Results) -> str:
    """How far a held-out view lies from the same of abcd-monolithic, in the view where that is worst."""
    joint = next(iter(results.of("abcd-monolithic")), None)
    pairs = _pairs(arm, joint) if results.settings and joint is not arm else []
    views = (zip(ours.views, theirs.views, strict=True) for ours, theirs in pairs)
    return mean_of(
        [min(our.psnr_merged - their.psnr_merged for our, their in pair) for pair in views], "+.2f"
    )


def notes(results: Results) -> list[str]:
    """What a reader of the table has to know, a sentence each."""
    found = [about_machine(results.machine)]
    if results.settings is not None:
        found = [_protocol(results), *found]
        found.append("Evaluation, saving and compiling are left out of the training time.")
        for run in results.runs:
            found += [f"LPIPS is missing: {run.lpips_reason}."] if run.lpips_reason else []
            found += [f"peak GPU memory is missing: {run.peak_device_note}."] if run.peak_device_note else []
            if run.ordering_gap_note:
                found.append(f"{run.method}: no ordering gap ({run.ordering_gap_note}).")
    if footings := [run.memory for run in results.runs if run.memory is not None]:
        base = min(footing.base_rss_bytes for footing in footings) / MIB
        found.append(f"Of the RAM, {base:,.0f} MiB are Python, torch and kernels, before any scene.")
    if any(_worst_view(arm, results) != NOTHING for arm in results.arms):
        found.append("Worst view: merged PSNR less abcd-monolithic's, in the view where that is least.")
    if len(results.seeds) > 1:
        found.append("Numbers are means over the seeds ± their standard deviation.")
    if any(results.baseline(arm) for arm in results.arms):
        found.append("Differences are those of merged PSNR to the method as it is, taken seed by seed.")
        found += ["One seed: a few tenths of a dB may be chance."] if len(results.seeds) == 1 else []
    if len({run.versions for run in results.runs}) > 1:
        found.append("Runs are of several versions, see results.json: differences may be due to that.")
    found += results.notes
    found += [f"{left.method} is left out: {left.reason}." for left in results.left_out]
    for failure in results.failures:
        what = "" if failure.variant == AS_IT_IS else f" {failure.variant},"
        found.append(f"{failure.method},{what} seed {failure.seed} failed ({failure.log}): {failure.reason}")
    return list(dict.fromkeys([*found, f"Command: `{results.command}`, {results.date[:10]}."]))


def _protocol(results: Results) -> str:
    s = results.settings
    budget = s.budget if s.seconds is None else f"{s.budget} of training"
    seeds = ("seed " if len(results.seeds) == 1 else "seeds ") + ", ".join(map(str, results.seeds))
    conditions = [f"{budget} a run", seeds]
    if s.blocks and set(results.methods) != {"abcd-monolithic"}:
        conditions.append(f"{s.blocks} blocks")
    held_out = f"every {HELD_OUT_EVERY}th view of the list sorted by name, from the first on"
    if s.hold_out == "auto":
        held_out = f"as the data list, without lists {held_out}"
    elif s.hold_out == "sector":
        held_out = f"one view in {HELD_OUT_EVERY}, all from one place"
    return f"Scene {s.scene} at 1/{s.downscale} of its size; held out: {held_out}; {', '.join(conditions)}."


def about_machine(machine: Machine) -> str:
    """One sentence about what the runs ran on."""
    return (
        f"{machine.cpu}, {many(machine.cores, 'core', 'cores')}, "
        f"{many(machine.torch_threads, 'torch thread', 'torch threads')}, "
        f"{machine.ram_bytes / GIB:.0f} GiB RAM, {machine.gpu or 'no GPU'}, {machine.os}."
    )


def write_table(results: Results, path: Path) -> None:
    """What was found, the tables and the notes, as Markdown."""
    parts = [*results.findings]
    parts += [markdown(rows(results))] if results.arms else []
    parts += [markdown(_of_outcomes(results.outcomes), align="---")] if results.outcomes else []
    parts.append("\n".join(f"- {note}" for note in notes(results)))
    path.write_text("\n\n".join(parts) + "\n", encoding="utf-8")


def _of_outcomes(outcomes: Sequence[Outcome]) -> Rows:
    table = [["", "fails elsewhere", "done here", "what each method did", ""]]
    for found in outcomes:
        said = "<br>".join(f"{method}: {words}" for method, words in found.said.items())
        verdict = ("pass" if found.passed else "**fail**") + (", one block is better" if found.worse else "")
        table.append([found.id, found.fails, f"{found.done}<br>*pass:* {found.rule}", said, verdict])
    return table


def markdown(table: Sequence[Sequence[str]], align: str = "---:") -> str:
    """A table, its first row the titles; `align` is that of all columns but the first."""
    cells = [[_in_cell(text) for text in row] for row in table]
    titles, *body = ("| " + " | ".join(row) + " |" for row in cells)
    return "\n".join([titles, "| --- |" + f" {align} |" * (len(cells[0]) - 1), *body])


def _in_cell(text: str) -> str:
    """Bars end a cell, also after a backslash that is escaped itself, and new lines a row."""
    return re.sub(r"(\\*)\|", r"\1\1\\|", " ".join(text.splitlines()))


def print_rows(table: Sequence[Sequence[str]], remarks: Sequence[str], console: Console) -> None:
    """A table in the terminal, its first row the titles, and below it a list of remarks."""
    titles, *body = table
    shown = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for i, title in enumerate(titles):
        shown.add_column(escape(title), justify="right" if i else "left", no_wrap=True)
    for row in body:
        shown.add_row(*map(escape, row))
    width = console.width
    # Wider than a narrow terminal rather than with numbers cut off.
    needed = Measurement.get(console, console.options.update(width=1000), shown).maximum
    console.width = max(width, needed)
    console.print(shown)
    console.width = width
    for remark in remarks:
        print_plain(f"- {remark}", console)
