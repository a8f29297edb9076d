"""The comparison's charts: held-out PSNR over training time, and over the number of Gaussians."""

from collections.abc import Callable, Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from abcd_ns.lab.results.results import Results
from abcd_ns.lab.results.run import CurvePoint, Run
from abcd_ns.lab.results.style import COLORS, MARKERS, in_style, label_ends, lay_grid, plot, save

Along = Callable[[CurvePoint], float]
"""What lies along the axis of x."""


@in_style
def draw_speed_accuracy(results: Results, out: Path) -> list[Path]:
    """Write speed_accuracy.png and .svg into `out`; returns their paths. Nothing without a run."""
    if not results.arms:
        return []
    figure = Figure(figsize=(5.6, 3.5), layout="constrained")
    axes = figure.add_subplot()
    ends = _draw_curves(axes, results, lambda point: point.seconds, "training time (s)")
    label_ends(axes, ends, 1.04 * max(seconds for seconds, _ in ends.values()))
    return save(figure, out, "speed_accuracy")


@in_style
def draw_size_accuracy(results: Results, out: Path) -> list[Path]:
    """Write size_accuracy.png and .svg: the way of each method through numbers of Gaussians and PSNR.

    Returns:
        Their paths; nothing without a run, or where runs of an older version counted no Gaussians.
    """
    if not results.arms or any(point.gaussians is None for run in results.runs for point in run.curve):
        return []
    figure = Figure(figsize=(5.6, 3.5), layout="constrained")
    axes = figure.add_subplot()
    title = "Gaussians in the scene (large mark: at the end)"
    ends = _draw_curves(axes, results, lambda point: point.gaussians, title)
    for method, end in ends.items():
        axes.plot(*end, MARKERS[method], color=COLORS[method], markersize=9, markeredgecolor="white")
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
    label_ends(axes, ends, 1.01 * axes.get_xlim()[1])
    return save(figure, out, "size_accuracy")


def mean_curve(runs: Sequence[Run], along: Along = lambda point: point.seconds) -> list[tuple[float, float]]:
    """(x, PSNR) at each moment, means over the seeds.

    Runs that passed a moment within one step lack its point; the curve then begins where the shortest does,
    the last point of every run being its end.
    """
    # Moments lie closest in the beginning, so that those which were passed are the first.
    length, count = min(len(run.curve) for run in runs), len(runs)
    moments = zip(*(run.curve[-length:] for run in runs), strict=True)
    return [(sum(map(along, points)) / count, sum(p.psnr for p in points) / count) for points in moments]


def _draw_curves(axes: Axes, results: Results, along: Along, title: str) -> dict[str, tuple[float, float]]:
    """Each method's curve, and thinly those of its seeds if there are several; returns their ends."""
    ends = {}
    for arm in results.arms:
        for run in arm.runs if len(arm.runs) > 1 else ():
            seed = {"color": COLORS[arm.method], "linewidth": 0.6, "alpha": 0.45}
            axes.plot([along(point) for point in run.curve], [point.psnr for point in run.curve], **seed)
        curve = mean_curve(arm.runs, along)
        plot(axes, *zip(*curve, strict=True), arm.method, markersize=4.5)
        ends[arm.method] = curve[-1]
    settings = results.settings
    blocks = f"{settings.blocks} blocks" if settings.blocks > 1 else "1 block"
    means = f", {results.means_of}" if results.means_of else ""
    axes.set_title(f"{settings.scene}, 1/{settings.downscale} size, {blocks}{means}", loc="left")
    axes.set_xlabel(title)
    axes.set_ylabel("held-out PSNR (dB)")
    axes.set_xlim(left=0)
    axes.margins(y=0.08)
    axes.xaxis.set_major_locator(MaxNLocator(6))
    axes.yaxis.set_major_locator(MaxNLocator(7))
    lay_grid(axes)
    return ends
