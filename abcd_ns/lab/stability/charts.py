"""One chart for each curve, in the style of the comparison's."""

from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from abcd_ns.lab.results.results import Curve, Line, Results
from abcd_ns.lab.results.style import COLORS, in_style, lay_grid, plot, save, tick_at

LOGARITHMIC = {"blocks", "visit-steps", "staleness", "views"}
"""Curves whose x doubles from point to point."""
LEAST_SPAN = 2.0
"""dB that the axis of y spans at least, so that noise does not look like a result."""
ONE_BLOCK = "abcd-monolithic"


@in_style
def draw_curves(results: Results, out: Path) -> list[Path]:
    """Write each curve's chart as png into `out`; returns their paths."""
    return [save(_draw(curve), out, curve.name) for curve in results.curves]


def _draw(curve: Curve) -> Figure:
    figure = Figure(figsize=(4.6, 3.1), layout="constrained")
    axes = figure.add_subplot()
    for line in curve.lines:
        _draw_line(axes, line)
    if curve.level is not None:
        label = f"{ONE_BLOCK}  {curve.level:.2f}"
        axes.axhline(curve.level, color=COLORS[ONE_BLOCK], linewidth=1.2, linestyle=(0, (5, 3)), label=label)
    values = [x for line in curve.lines for x in line.x]
    tick_at(axes, values, lambda value: f"{value:g}", 2 if curve.name in LOGARITHMIC else None)
    axes.margins(x=0.08, y=0.12)
    low, high = axes.get_ylim()
    lack = max(LEAST_SPAN - (high - low), 0.0) / 2
    axes.set_ylim(low - lack, high + lack)
    axes.yaxis.set_major_locator(MaxNLocator(6))
    axes.set_xlabel(curve.x_label)
    axes.set_ylabel("held-out PSNR (dB)")
    axes.set_title(curve.title + (f"\n{curve.note}" if curve.note else ""), loc="left")
    axes.legend(frameon=False, fontsize=7.5)
    lay_grid(axes)
    return figure


def _draw_line(axes: Axes, line: Line) -> None:
    method, _, differs = line.name.partition(",")
    plot(axes, line.x, line.psnr, method, linestyle=(0, (2, 1.5)) if differs else "-", label=line.name)
