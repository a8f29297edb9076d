"""The charts of a comparison: PSNR over training time, PSNR over Gaussians, memory over Gaussians."""

from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import fmean

from matplotlib.axes import Axes
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from abcd_ns.lab.results.results import Arm, CurvePoint, Results, Run
from abcd_ns.lab.results.style import COLORS, MARKERS, in_style, lay_grid, save
from abcd_ns.units import MIB

Along = Callable[[CurvePoint], float]  # what lies along the axis of x
PALEST = 0.55  # share of white in the colour of a method's last arm


@in_style
def draw_charts(results: Results, out: Path, prefix: str = "") -> list[Path]:
    """Write what there is to draw as png into `out`; returns the paths. Nothing without a run."""
    if not results.arms:
        return []
    paths, points = [], [point for run in results.runs for point in run.curve]
    if all(run.curve for run in results.runs):
        chart = _draw_curves(results, lambda point: point.seconds, "training time (s)")
        paths.append(save(chart, out, f"{prefix}speed_accuracy"))
        if not any(point.gaussians is None for point in points):
            chart = _draw_curves(results, lambda point: point.gaussians, "Gaussians in the scene")
            paths.append(save(chart, out, f"{prefix}size_accuracy"))
    return [*paths, save(_draw_memory(results), out, f"{prefix}memory")]


def mean_curve(runs: Sequence[Run], along: Along) -> list[tuple[float, float]]:
    """(x, PSNR) at each moment, means over the seeds.

    Runs that passed a moment within one step lack its point; the curve then begins where the shortest does,
    the last point of every run being its end.
    """
    # Moments lie closest in the beginning, so that those which were passed are the first.
    length = min(len(run.curve) for run in runs)
    moments = zip(*(run.curve[-length:] for run in runs), strict=True)
    return [(fmean(map(along, points)), fmean(point.psnr for point in points)) for points in moments]


def colors_of(arms: Sequence[Arm]) -> dict[str, str]:
    """By name: the method's colour, paler from arm to arm of the same method."""
    found = {}
    for arm in arms:
        same = [other for other in arms if other.method == arm.method]
        white = PALEST * same.index(arm) / max(len(same) - 1, 1)
        found[arm.name] = to_hex([part + (1 - part) * white for part in to_rgb(COLORS[arm.method])])
    return found


def _draw_curves(results: Results, along: Along, x_label: str) -> Figure:
    """Each arm's curve, and thinly those of its seeds if there are several."""
    figure, axes = _begin(results)
    colors, labels = colors_of(results.arms), results.labels
    for arm in results.arms:
        color, curve = colors[arm.name], mean_curve(arm.runs, along)
        for run in arm.runs if len(arm.runs) > 1 else ():
            x, y = [along(point) for point in run.curve], [point.psnr for point in run.curve]
            axes.plot(x, y, color=color, linewidth=0.6, alpha=0.45)
        label = f"{labels[arm.name]}  {curve[-1][1]:.2f}"
        axes.plot(*zip(*curve, strict=True), color=color, marker=MARKERS[arm.method], label=label)
    axes.set(xlabel=x_label, ylabel="held-out PSNR (dB)", xlim=(0, None))
    if x_label.startswith("Gaussians"):
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    figure.legend(loc="outside right center")
    return figure


def _begin(results: Results) -> tuple[Figure, Axes]:
    longest = max(map(len, results.labels.values()))
    size = (4.6 + 0.07 * longest, max(3.5, 0.25 * len(results.arms)))
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.add_subplot()
    lay_grid(axes)
    axes.set_title(results.title, loc="left")
    return figure, axes


def _draw_memory(results: Results) -> Figure:
    """RAM, and GPU memory where it is known, against the Gaussians at the end; a mark for each arm."""
    figure, axes = _begin(results)
    left_out = {left.method for left in results.left_out}
    for method in results.methods:
        arms = sorted(results.of(method), key=lambda arm: arm.mean("gaussians"))
        for name, field, line in (("RAM", "peak_rss_bytes", "-"), ("GPU", "peak_device_bytes", "--")):
            known = [arm for arm in arms if all(getattr(run, field) is not None for run in arm.runs)]
            x = [arm.mean("gaussians") for arm in known]
            y = [arm.mean(field) / MIB for arm in known]
            ended = ", then out of memory" if method in left_out and name == "GPU" else ""
            look = {"color": COLORS[method], "marker": MARKERS[method], "linestyle": line}
            if known:
                axes.plot(x, y, label=f"{method}, {name}{ended}", **look)
    if bases := [run.memory.base_rss_bytes / MIB for run in results.runs if run.memory is not None]:
        axes.axhline(min(bases), color="#888888", linewidth=0.8, linestyle=":", label="RAM before any scene")
    axes.set(xlabel="Gaussians in the scene at the end", ylabel="peak memory (MiB)", ylim=(0, None))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    figure.legend(loc="outside right center")
    return figure
