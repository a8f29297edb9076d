"""The parts' records as charts, in the style of all others, and as short tables."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from rich.console import Console

from abcd_ns.lab.compare.charts import draw_charts
from abcd_ns.lab.results.records import decode
from abcd_ns.lab.results.results import Results
from abcd_ns.lab.results.style import in_style, save
from abcd_ns.lab.results.tables import notes, print_rows, rows

Record = dict[str, Any]
STAGES = ("#0072B2", "#56A0D3", "#D55E00", "#007A5A", "#8A6A00", "#8A5A83", "#B3306B", "#888888", "#444444")


def draw(records: Sequence[Record], out: Path) -> list[Path]:
    """Draw what there is to draw; the paths of the charts."""
    drawn: list[Path] = []
    for record in records:
        part, found = record["part"], record["found"]
        if (results := _results(found)) is not None:
            drawn += draw_charts(results, out, f"{part}-")
        elif part == "visit" and found.get("by_blocks"):
            drawn.append(_draw_visit(found, out))
    return drawn


def show(records: Sequence[Record], console: Console) -> None:
    """A table for each part, below it what went wrong."""
    for record in records:
        table, remarks = _rows(record["part"], record["found"])
        trouble = [f"{record['part']}: {record['error']}"] if record["error"] else []
        dry = ["a dry run: these numbers mean nothing"] if record["dry_run"] else []
        print_rows(table, [*dry, *remarks, *trouble], console)


def _rows(part: str, found: Record) -> tuple[list[list[str]], list[str]]:
    """A part's table, titles first, and notes."""
    if not found:
        return [[part]], []
    if (results := _results(found)) is not None:
        return rows(results), [*results.findings, *notes(results)]
    if part == "visit":
        columns = found["by_blocks"]
        titles = ["visit, ms a view", *(f"{column['blocks']} blocks" for column in columns)]
        stages = columns[0]["ms_per_view"] if columns else {}
        body = [[stage, *(f"{column['ms_per_view'][stage]:.2f}" for column in columns)] for stage in stages]
        return [titles, *body], []
    if part == "tests":
        counts = ("passed", "failed", "skipped")
        why = [f"{test}: {reason}" for test, reason in found["why_failed"].items()]
        return [["tests", *counts], ["", *(str(found[count]) for count in counts)]], why
    flat = {**found["hardware"], **{name: value for name, value in found.items() if name != "hardware"}}
    return [["build", ""], *([name, str(value)] for name, value in flat.items())], []


def _results(found: Record) -> Results | None:
    """Of a part that is an experiment."""
    return decode(Results, found["results"], "results") if found.get("results") else None


@in_style
def _draw_visit(found: Record, out: Path) -> Path:
    """The stages of a view's share of a visit, end to end, a bar for each number of blocks."""
    figure = Figure(figsize=(7.2, 1.4 + 0.4 * len(found["by_blocks"])), layout="constrained")
    axes = figure.add_subplot()
    names = [f"{column['blocks']} blocks" for column in found["by_blocks"]]
    left = [0.0] * len(names)
    for color, stage in zip(STAGES, found["by_blocks"][0]["ms_per_view"], strict=True):
        spans = [column["ms_per_view"][stage] for column in found["by_blocks"]]
        axes.barh(names, spans, left=left, color=color, label=stage, height=0.6)
        left = [start + span for start, span in zip(left, spans, strict=True)]
    axes.invert_yaxis()
    axes.set_xlabel("ms a view, each stage until the device is done")
    axes.set_title(found["scene"], loc="left")
    figure.legend(loc="outside lower center", ncols=5, frameon=False, fontsize=7)
    return save(figure, out, "visit")
