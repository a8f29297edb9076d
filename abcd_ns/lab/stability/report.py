"""stability.json and table.md: for each way to fail, what was done and what each method did."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from abcd_ns.lab.runs.records import encode, read_record, write_json
from abcd_ns.lab.runs.tables import about_machine
from abcd_ns.lab.stability.charts import draw_curves
from abcd_ns.lab.stability.curves import Curve
from abcd_ns.lab.stability.outcome import Outcome
from abcd_ns.nerfstudio.machine import Machine, Versions

SCHEMA = 1
RESULTS_FILE, TABLE_FILE = "stability.json", "table.md"


@dataclass(frozen=True)
class Report:
    """All of stability.json."""

    schema: int
    date: str
    command: str
    machine: Machine
    versions: Versions
    outcomes: tuple[Outcome, ...]
    curves: tuple[Curve, ...]


def read_report(path: Path) -> Report:
    """As `write_report` wrote it.

    Raises:
        RecordError: it is absent, or of another schema.
    """
    return read_record(path, Report, SCHEMA)


def write_report(report: Report, out: Path) -> list[Path]:
    """Write stability.json, table.md and the charts; returns their paths."""
    write_json(out / RESULTS_FILE, encode(report))
    (out / TABLE_FILE).write_text(markdown(report), encoding="utf-8")
    return [out / RESULTS_FILE, out / TABLE_FILE, *draw_curves(report.curves, out)]


def verdict(outcome: Outcome) -> str:
    """Pass or fail in words, and whether one block does better."""
    word = "pass" if outcome.passed else "**fail**"
    return f"{word}, one block is better" if outcome.worse else word


def headline(outcomes: Sequence[Outcome]) -> str:
    """One sentence about all of them."""
    passed = sum(outcome.passed for outcome in outcomes)
    failed = [outcome.id for outcome in outcomes if not outcome.passed]
    worse = [outcome.id for outcome in outcomes if outcome.worse]
    text = f"{passed} of {len(outcomes)} scenarios pass"
    text += f"; these fail: {', '.join(failed)}" if failed else ""
    return text + (f"; one block does better, by however little, in {', '.join(worse)}." if worse else ".")


def markdown(report: Report) -> str:
    """The table, a row per scenario, and a small one for each curve."""
    lines = [headline(report.outcomes), "", "| | fails elsewhere | done here | what each method did | |"]
    lines.append("| --- | --- | --- | --- | --- |")
    for outcome in report.outcomes:
        said = "<br>".join(f"{method}: {words}" for method, words in outcome.said.items())
        cells = (outcome.id, outcome.fails, f"{outcome.done}<br>*pass:* {outcome.rule}", said)
        lines.append("| " + " | ".join(map(_cell, cells)) + f" | {verdict(outcome)} |")
    for curve in report.curves:
        lines += ["", *_curve(curve)]
    made = f"Made by `{report.command}` on {report.date[:10]}. {about_machine(report.machine)}"
    return "\n".join([*lines, "", made, ""])


def print_outcome(outcome: Outcome, console: Console) -> None:
    """A scenario's lines in the terminal."""
    word = "pass" if outcome.passed else "FAIL"
    head = f"{outcome.id:>4}  {word}  {outcome.fails}  ({outcome.seconds:.0f} s)"
    console.print(head, highlight=False, soft_wrap=True)
    for method, words in outcome.said.items():
        console.print(f"            {method}: {words}", highlight=False, markup=False, soft_wrap=True)


def _curve(curve: Curve) -> list[str]:
    values = list(curve.lines[0].x)
    head = [f"{curve.title}: held-out PSNR (dB) by {curve.x_label}", *(f"{x:g}" for x in values)]
    rows = ["| " + " | ".join(head) + " |", "| --- |" + " ---: |" * len(values)]
    for line in curve.lines:
        rows.append("| " + " | ".join([line.name, *(f"{value:.2f}" for value in line.psnr)]) + " |")
    if curve.level is not None:
        rows.append("| " + " | ".join(["one block", *[f"{curve.level:.2f}"] * len(values)]) + " |")
    return rows + ([f"\n{curve.note}."] if curve.note else [])


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")
