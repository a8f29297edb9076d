"""The speed-against-accuracy chart: held-out PSNR over training seconds, one curve a method."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from abcd_ns.tools.compare.results import CurvePoint, Results, Run

COLORS = {
    "abcd-monolithic": "#D55E00",
    "abcd": "#0072B2",
    "abcd-ablated": "#8A5A83",
    "abcd-partition": "#8A6A00",
    "abcd-exact": "#B3306B",
    "abcd-paper": "#7A3E00",
    "splatfacto": "#007A5A",
}
"""After Okabe and Ito 2008, told apart with every kind of colour blindness; darkened where text needs it."""
MARKERS = {
    "abcd-monolithic": "s",
    "abcd": "o",
    "abcd-ablated": "^",
    "abcd-partition": "v",
    "abcd-exact": "X",
    "abcd-paper": "P",
    "splatfacto": "D",
}
"""For print without colour."""
STYLE = {
    "font.family": "sans-serif",
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "svg.fonttype": "none",  # text stays text: searchable, and set in the paper's font
    "svg.hashsalt": "abcd",  # the same chart gives the same bytes
}
FORMATS = ("png", "svg")
LABEL_GAP = 0.06
"""Least distance of two labels, as a share of the axis' height."""


def draw_speed_accuracy(results: Results, out: Path) -> list[Path]:
    """Write speed_accuracy.png and .svg into `out`; returns their paths. Nothing without a run."""
    if not results.runs:
        return []
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(5.6, 3.5), layout="constrained")
        axes = figure.add_subplot()
        ends = {method: _draw_curves(axes, method, results.of(method)) for method in results.methods}
        _dress(axes, results)
        _label(axes, ends)
        paths = [out / f"speed_accuracy.{ending}" for ending in FORMATS]
        for path in paths:
            figure.savefig(path, dpi=300, metadata={"Date": None} if path.suffix == ".svg" else None)
    return paths


def mean_curve(runs: Sequence[Run]) -> list[tuple[float, float]]:
    """(seconds, PSNR) at each moment, means over the seeds.

    Runs that passed a moment within one step lack its point; the curve then ends where the shortest does,
    the last point of every run being its end.
    """
    length = min(len(run.curve) for run in runs)
    rows = [[*run.curve[: length - 1], run.curve[-1]] for run in runs]
    return [_mean_point(points) for points in zip(*rows, strict=True)]


def spread(wanted: Sequence[float], gap: float) -> list[float]:
    """Positions near the `wanted` ones, in their order of height, at least `gap` apart."""
    order = np.argsort(wanted, kind="stable")
    placed = np.asarray(wanted, dtype=float)[order]
    for _ in range(100):
        moved = False
        for i in range(len(placed) - 1):
            lack = gap - (placed[i + 1] - placed[i])
            if lack > 1e-9:
                placed[i] -= lack / 2
                placed[i + 1] += lack / 2
                moved = True
        if not moved:
            break
    result = np.empty_like(placed)
    result[order] = placed
    return result.tolist()


def _mean_point(points: Sequence[CurvePoint]) -> tuple[float, float]:
    count = len(points)
    return sum(point.seconds for point in points) / count, sum(point.psnr for point in points) / count


def _draw_curves(axes: Axes, method: str, runs: Sequence[Run]) -> tuple[float, float]:
    """Draw a method's curve, and thinly those of its seeds if there are several; returns its end."""
    color = COLORS[method]
    if len(runs) > 1:
        for run in runs:
            axes.plot(
                [point.seconds for point in run.curve],
                [point.psnr for point in run.curve],
                color=color,
                linewidth=0.6,
                alpha=0.45,
            )
    curve = mean_curve(runs)
    axes.plot(
        *zip(*curve, strict=True),
        color=color,
        marker=MARKERS[method],
        markersize=4.5,
        markeredgecolor="white",
        markeredgewidth=0.5,
        linewidth=1.4,
    )
    return curve[-1]


def _dress(axes: Axes, results: Results) -> None:
    protocol = results.protocol
    axes.set_xlabel("training time (s)")
    axes.set_ylabel("held-out PSNR (dB)")
    blocks = f"{protocol.blocks} blocks" if protocol.blocks > 1 else "1 block"
    seeds = f", mean of {len(protocol.seeds)} seeds" if len(protocol.seeds) > 1 else ""
    axes.set_title(f"{protocol.scene}, 1/{protocol.downscale} size, {blocks}{seeds}", loc="left")
    axes.set_xlim(left=0)
    axes.margins(y=0.08)
    axes.xaxis.set_major_locator(MaxNLocator(6))
    axes.yaxis.set_major_locator(MaxNLocator(7))
    axes.grid(color="#d9d9d9", linewidth=0.5)
    axes.set_axisbelow(True)


def _label(axes: Axes, ends: dict[str, tuple[float, float]]) -> None:
    """Each method's name beside the end of its curve, in its colour."""
    low, high = axes.get_ylim()
    heights = spread([psnr for _, psnr in ends.values()], LABEL_GAP * (high - low))
    right = max(seconds for seconds, _ in ends.values())
    for (method, (seconds, psnr)), height in zip(ends.items(), heights, strict=True):
        axes.annotate(
            f"{method}  {psnr:.2f}",
            xy=(seconds, psnr),
            xytext=(right * 1.04, height),
            color=COLORS[method],
            va="center",
            annotation_clip=False,
            arrowprops={
                "arrowstyle": "-",
                "color": COLORS[method],
                "linewidth": 0.5,
                "shrinkB": 3,
                "relpos": (0, 0.5),
            },
        )
