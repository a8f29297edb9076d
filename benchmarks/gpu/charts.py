"""The parts' records as charts, in the style of all others, and as short tables."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.console import Console

from abcd_ns.lab.results.records import decode
from abcd_ns.lab.results.results import Results
from abcd_ns.lab.results.run import Run
from abcd_ns.lab.results.style import COLORS, MARKERS, in_style, label_ends, lay_grid, save
from abcd_ns.lab.results.tables import cell, measures_of, notes, print_rows, rows
from abcd_ns.lab.scale.charts import draw_scale
from abcd_ns.units import GIB

Record = dict[str, Any]
SHADES = ("#0072B2", "#56A0D3", "#003A5D")
"""Of `abcd` with different numbers of blocks."""
STAGES = ("#0072B2", "#56A0D3", "#D55E00", "#007A5A", "#8A6A00", "#8A5A83", "#B3306B", "#888888", "#444444")


COMPARED = ("psnr_merged", "ssim_merged", "gaussians", "steps", "train_seconds")
COMPARED += ("peak_device_bytes", "peak_reserved_bytes")
"""Fields of each arm's run that a comparison's table shows."""


def draw(records: Sequence[Record], out: Path) -> list[Path]:
    """Draw what there is to draw; the paths of the charts, png and svg."""
    drawn: list[Path] = []
    for record in records:
        part, found = record["part"], record["found"]
        if (results := _results(found)) is not None:
            drawn += draw_scale(results, out) if part == "extent" else _draw_comparison(part, results, out)
        elif part == "visit" and found.get("by_blocks"):
            drawn += _draw_visit(found, out)
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
        table = rows(results) if part == "extent" else _rows_of_comparison(part, results)
        return table, [*results.findings, *notes(results)]
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


def _rows_of_comparison(part: str, results: Results) -> list[list[str]]:
    shown = measures_of(COMPARED)
    body = [[arm.name, *(cell(arm.runs, measure) for measure in shown)] for arm in results.arms]
    return [[part, *(measure.title for measure in shown)], *body]


@in_style
def _draw_comparison(part: str, results: Results, out: Path) -> list[Path]:
    """Held-out PSNR over training time, and what each arm took of the GPU; nothing without a run."""
    if not results.arms:
        return []
    shades, settings = iter(SHADES), results.settings
    runs = {arm.name: arm.runs[0] for arm in results.arms}
    colors = {
        name: next(shades) if name.startswith("abcd blocks") else COLORS[run.method]
        for name, run in runs.items()
    }
    figure = Figure(figsize=(9.0, 3.5), layout="constrained")
    curves, memory = figure.subplots(1, 2, width_ratios=(1.6, 1))
    ends = {}
    for name, run in runs.items():
        line = [(point.seconds, point.psnr) for point in run.curve]
        curves.plot(*zip(*line, strict=True), color=colors[name], marker=MARKERS[run.method], markersize=4)
        ends[name] = line[-1]
    curves.set_title(f"{settings.scene}, {settings.budget} a run", loc="left")
    curves.set(xlabel="training time (s)", ylabel="held-out PSNR (dB)", xlim=(0, None))
    lay_grid(curves)
    label_ends(curves, ends, 1.04 * max(seconds for seconds, _ in ends.values()), colors)
    _bars(memory, runs, colors)
    return save(figure, out, part)


def _bars(axes: Axes, runs: Mapping[str, Run], colors: dict[str, str]) -> None:
    """Peak GPU memory: dark what tensors held, pale what torch had taken for them."""
    for alpha, key in ((0.35, "peak_reserved_bytes"), (1.0, "peak_device_bytes")):
        sizes = [(getattr(run, key) or 0) / GIB for run in runs.values()]
        axes.barh(list(runs), sizes, color=[colors[name] for name in runs], alpha=alpha)
    axes.invert_yaxis()
    axes.set(xlabel="peak GPU memory (GiB)\npale: reserved", xlim=(0, None))
    lay_grid(axes)


@in_style
def _draw_visit(found: Record, out: Path) -> list[Path]:
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
