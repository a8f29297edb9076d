"""The parts' records as charts, in the style of all others, and as short tables."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from abcd_ns.lab.compare.charts import draw_charts
from abcd_ns.lab.results.records import decode
from abcd_ns.lab.results.results import Results
from abcd_ns.lab.results.tables import notes, print_rows, rows

Record = dict[str, Any]


def draw(records: Sequence[Record], out: Path) -> list[Path]:
    """Draw what there is to draw; the paths of the charts."""
    found = {record["part"]: _results(record["found"]) for record in records}
    return [p for part, results in found.items() if results for p in draw_charts(results, out, f"{part}-")]


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
    flat = {**found["hardware"], **{name: value for name, value in found.items() if name != "hardware"}}
    return [["build", ""], *([name, str(value)] for name, value in flat.items())], []


def _results(found: Record) -> Results | None:
    """Of a part that is an experiment."""
    return decode(Results, found["results"], "results") if found.get("results") else None
