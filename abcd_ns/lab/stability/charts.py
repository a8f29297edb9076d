"""One chart for each curve, in the style of the comparison's."""

from pathlib import Path

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullLocator

from abcd_ns.lab.runs.style import COLORS, MARKERS, STYLE, lay_grid, save
from abcd_ns.lab.stability.curves import Curve, Line

LOGARITHMIC = {"blocks", "visit-steps", "staleness", "views"}
"""Curves whose x doubles from point to point."""
LEAST_SPAN = 2.0
"""dB that the axis of y spans at least, so that noise does not look like a result."""
ONE_BLOCK = "abcd-monolithic"


def draw_curves(curves: tuple[Curve, ...], out: Path) -> list[Path]:
    """Write each curve's chart as png and svg into `out`; returns their paths."""
    with matplotlib.rc_context(STYLE):
        return [path for curve in curves for path in save(_draw(curve), out, curve.name)]


def _draw(curve: Curve) -> Figure:
    figure = Figure(figsize=(4.6, 3.1), layout="constrained")
    axes = figure.add_subplot()
    for line in curve.lines:
        _draw_line(axes, line)
    if curve.level is not None:
        label = f"{ONE_BLOCK}  {curve.level:.2f}"
        axes.axhline(curve.level, color=COLORS[ONE_BLOCK], linewidth=1.2, linestyle=(0, (5, 3)), label=label)
    values = sorted({x for line in curve.lines for x in line.x})
    if curve.name in LOGARITHMIC:
        axes.set_xscale("log", base=2)
    axes.xaxis.set_major_locator(FixedLocator(values))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
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
    axes.plot(
        line.x,
        line.psnr,
        color=COLORS[method],
        marker=MARKERS[method],
        markersize=5,
        markeredgecolor="white",
        markeredgewidth=0.5,
        linewidth=1.4,
        linestyle=(0, (2, 1.5)) if differs else "-",
        label=line.name,
    )
