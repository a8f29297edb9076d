"""The charts of a comparison: PSNR over time, Gaussians and peak memory, and memory over Gaussians."""

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
QUALITY = {"psnr_merged": "held-out PSNR (dB)", "ssim_merged": "held-out SSIM"}
"""By field of a run, what the chart of budgets shows of it."""


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


@in_style
def draw_budgets(results: Results, out: Path) -> list[Path]:
    """Write PSNR and SSIM over peak memory as png into `out`; nothing where no arm has a budget."""
    arms = [arm for arm in results.arms if all(run.gaussian_bytes for run in arm.runs)]
    if not any(arm.is_budgeted for arm in arms):
        return []
    figure = Figure(figsize=(7.2, 3.6), layout="constrained")
    for axes, (field, title) in zip(figure.subplots(1, 2), QUALITY.items(), strict=True):
        lay_grid(axes)
        for method in results.methods:
            own = sorted((arm for arm in arms if arm.method == method), key=_mebibytes)
            _draw_method(axes, method, own, field)
        axes.set(xscale="log", xlabel="peak memory of Gaussians (MiB)", ylabel=title)
        for which in (axes.xaxis.set_major_formatter, axes.xaxis.set_minor_formatter):
            which(lambda value, _: f"{value:g}" if f"{value:e}"[0] in "125" else "")
    figure.suptitle(results.title, x=0.02, ha="left")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return [save(figure, out, "memory_accuracy")]


def _draw_method(axes: Axes, method: str, arms: Sequence[Arm], field: str) -> None:
    """A line through its budgets, bars from the lowest seed to the highest; dotted what no limit gives."""
    look = {"color": COLORS[method], "marker": MARKERS[method]}
    if within := [arm for arm in arms if arm.is_budgeted]:
        means = [arm.mean(field) for arm in within]
        ends = [[getattr(run, field) for run in arm.runs] for arm in within]
        bars = [[mean - min(e), max(e) - mean] for mean, e in zip(means, ends, strict=True)]
        x = list(map(_mebibytes, within))
        axes.errorbar(x, means, list(zip(*bars, strict=True)), label=f"{method} within a budget", **look)
    for arm in arms:
        if not arm.is_budgeted:
            axes.axhline(arm.mean(field), color=look["color"], linewidth=0.8, linestyle=":")
            label = f"{method} without a limit"
            axes.plot([_mebibytes(arm)], [arm.mean(field)], linestyle="", label=label, **look)


def _mebibytes(arm: Arm) -> float:
    return arm.mean("gaussian_bytes") / MIB
