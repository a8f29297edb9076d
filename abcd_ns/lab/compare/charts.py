"""The comparison's charts: held-out PSNR over training time, and over the number of Gaussians."""

from collections.abc import Callable, Sequence
from pathlib import Path

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from abcd_ns.lab.compare.results import Results
from abcd_ns.lab.runs.run import CurvePoint, Run
from abcd_ns.lab.runs.style import COLORS, MARKERS, STYLE, label_ends, lay_grid, save

Along = Callable[[CurvePoint], float]
"""What lies along the axis of x."""


def draw_speed_accuracy(results: Results, out: Path) -> list[Path]:
    """Write speed_accuracy.png and .svg into `out`; returns their paths. Nothing without a run."""
    if not results.runs:
        return []
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(5.6, 3.5), layout="constrained")
        axes = figure.add_subplot()
        ends = {m: _draw_curves(axes, m, results.of(m), lambda point: point.seconds) for m in results.methods}
        _dress(axes, results, "training time (s)")
        label_ends(axes, ends, 1.04 * max(seconds for seconds, _ in ends.values()))
        return save(figure, out, "speed_accuracy")


def draw_size_accuracy(results: Results, out: Path) -> list[Path]:
    """Write size_accuracy.png and .svg: the way of each method through numbers of Gaussians and PSNR.

    Returns:
        Their paths; nothing without a run, or where runs of an older version counted no Gaussians.
    """
    if not results.runs or any(point.gaussians is None for run in results.runs for point in run.curve):
        return []
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(5.6, 3.5), layout="constrained")
        axes = figure.add_subplot()
        ends = {m: _draw_curves(axes, m, results.of(m), lambda p: p.gaussians) for m in results.methods}
        for method, end in ends.items():
            axes.plot(*end, MARKERS[method], color=COLORS[method], markersize=9, markeredgecolor="white")
        _dress(axes, results, "Gaussians in the scene (large mark: at the end)")
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
        label_ends(axes, ends, 1.01 * axes.get_xlim()[1])
        return save(figure, out, "size_accuracy")


def mean_curve(runs: Sequence[Run], along: Along = lambda point: point.seconds) -> list[tuple[float, float]]:
    """(x, PSNR) at each moment, means over the seeds.

    Runs that passed a moment within one step lack its point; the curve then ends where the shortest does,
    the last point of every run being its end.
    """
    length = min(len(run.curve) for run in runs)
    rows = [[*run.curve[: length - 1], run.curve[-1]] for run in runs]
    return [_mean_point(points, along) for points in zip(*rows, strict=True)]


def _mean_point(points: Sequence[CurvePoint], along: Along) -> tuple[float, float]:
    count = len(points)
    return sum(along(point) for point in points) / count, sum(point.psnr for point in points) / count


def _draw_curves(axes: Axes, method: str, runs: Sequence[Run], along: Along) -> tuple[float, float]:
    """Draw a method's curve, and thinly those of its seeds if there are several; returns its end."""
    color = COLORS[method]
    if len(runs) > 1:
        for run in runs:
            axes.plot(
                [along(point) for point in run.curve],
                [point.psnr for point in run.curve],
                color=color,
                linewidth=0.6,
                alpha=0.45,
            )
    curve = mean_curve(runs, along)
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


def _dress(axes: Axes, results: Results, along: str) -> None:
    protocol = results.protocol
    axes.set_xlabel(along)
    axes.set_ylabel("held-out PSNR (dB)")
    blocks = f"{protocol.blocks} blocks" if protocol.blocks > 1 else "1 block"
    seeds = f", mean of {len(protocol.seeds)} seeds" if len(protocol.seeds) > 1 else ""
    axes.set_title(f"{protocol.scene}, 1/{protocol.downscale} size, {blocks}{seeds}", loc="left")
    axes.set_xlim(left=0)
    axes.margins(y=0.08)
    axes.xaxis.set_major_locator(MaxNLocator(6))
    axes.yaxis.set_major_locator(MaxNLocator(7))
    lay_grid(axes)
