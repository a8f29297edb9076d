"""The charts of a comparison: PSNR over training time, PSNR over Gaussians, memory over Gaussians."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from statistics import fmean

from matplotlib.axes import Axes
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from abcd_ns.lab.results.results import Arm, Results
from abcd_ns.lab.results.run import CurvePoint, Run
from abcd_ns.lab.results.style import (
    COLORS,
    MARKERS,
    in_style,
    label_ends,
    lay_grid,
    plot,
    save,
    short,
    write_beside,
)
from abcd_ns.units import MIB

Along = Callable[[CurvePoint], float]
"""What lies along the axis of x."""
Ends = dict[str, tuple[float, float]]
"""Where lines end, by name."""
PALEST = 0.55
"""Share of white in the colour of a method's last arm."""


def draw_charts(results: Results, out: Path, prefix: str = "") -> list[Path]:
    """Write what there is to draw as png into `out`; returns the paths. Nothing without a run."""
    if not results.arms:
        return []
    paths, curves = [], [run.curve for run in results.runs]
    if all(curves):
        paths.append(save(_draw_time(results), out, f"{prefix}speed_accuracy"))
    if all(curves) and not any(point.gaussians is None for curve in curves for point in curve):
        paths.append(save(_draw_size(results), out, f"{prefix}size_accuracy"))
    return [*paths, save(_draw_memory(results), out, f"{prefix}memory")]


def mean_curve(runs: Sequence[Run], along: Along = lambda point: point.seconds) -> list[tuple[float, float]]:
    """(x, PSNR) at each moment, means over the seeds.

    Runs that passed a moment within one step lack its point; the curve then begins where the shortest does,
    the last point of every run being its end.
    """
    # Moments lie closest in the beginning, so that those which were passed are the first.
    length, count = min(len(run.curve) for run in runs), len(runs)
    moments = zip(*(run.curve[-length:] for run in runs), strict=True)
    return [(sum(map(along, points)) / count, sum(p.psnr for p in points) / count) for points in moments]


def colors_of(arms: Sequence[Arm]) -> dict[str, str]:
    """By name: the method's colour, paler from arm to arm of the same method."""
    found = {}
    for arm in arms:
        same = [other for other in arms if other.method == arm.method]
        white = PALEST * same.index(arm) / max(len(same) - 1, 1)
        found[arm.name] = to_hex([part + (1 - part) * white for part in to_rgb(COLORS[arm.method])])
    return found


@in_style
def _draw_time(results: Results) -> Figure:
    figure, axes = _begin(results)
    colors = colors_of(results.arms)
    ends = _draw_curves(axes, results, colors, lambda point: point.seconds)
    axes.set(xlabel="training time (s)", xlim=(0, None))
    _label(axes, results, ends, 1.04 * max(seconds for seconds, _ in ends.values()), colors)
    return figure


@in_style
def _draw_size(results: Results) -> Figure:
    figure, axes = _begin(results)
    colors = colors_of(results.arms)
    ends = _draw_curves(axes, results, colors, lambda point: point.gaussians)
    for arm in results.arms:
        look = {"color": colors[arm.name], "markersize": 9, "markeredgecolor": "white"}
        axes.plot(*ends[arm.name], MARKERS[arm.method], **look)
    axes.set(xlabel="Gaussians in the scene (large mark: at the end)", xlim=(0, None))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: short(value)))
    _label(axes, results, ends, 1.01 * axes.get_xlim()[1], colors)
    return figure


def _begin(results: Results) -> tuple[Figure, Axes]:
    longest = max(map(len, results.labels.values()))
    size = (4.6 + 0.07 * longest, max(3.5, 0.25 * len(results.arms)))
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.add_subplot()
    if (settings := results.settings) is None:
        return figure, axes
    blocks = [f"{settings.blocks} block{'s' * (settings.blocks > 1)}"] if settings.blocks else []
    means = [results.means_of] if results.means_of else []
    parts = [settings.scene, f"1/{settings.downscale} size", *blocks, settings.budget, *means]
    axes.set_title(", ".join(parts), loc="left")
    return figure, axes


def _draw_curves(axes: Axes, results: Results, colors: Mapping[str, str], along: Along) -> Ends:
    """Each arm's curve, and thinly those of its seeds if there are several."""
    ends = {}
    for arm in results.arms:
        color = colors[arm.name]
        for run in arm.runs if len(arm.runs) > 1 else ():
            x, y = [along(point) for point in run.curve], [point.psnr for point in run.curve]
            axes.plot(x, y, color=color, linewidth=0.6, alpha=0.45)
        curve = mean_curve(arm.runs, along)
        plot(axes, *zip(*curve, strict=True), arm.method, color=color, markersize=4.5)
        ends[arm.name] = curve[-1]
    axes.set_ylabel("held-out PSNR (dB)")
    axes.margins(y=0.08)
    axes.xaxis.set_major_locator(MaxNLocator(6))
    axes.yaxis.set_major_locator(MaxNLocator(7))
    lay_grid(axes)
    return ends


def _label(axes: Axes, results: Results, ends: Ends, right: float, colors: Mapping[str, str]) -> None:
    labels = results.labels
    label_ends(axes, ends, right, colors, lambda name, psnr: f"{labels[name]}  {psnr:.2f}")


@in_style
def _draw_memory(results: Results) -> Figure:
    """RAM, and GPU memory where it is known, against the Gaussians at the end; a mark for each arm."""
    figure, axes = _begin(results)
    ends: Ends = {}
    colors: dict[str, str] = {}
    for method in results.methods:
        arms = sorted(results.of(method), key=lambda arm: arm.gaussians)
        for name, field, line in (("RAM", "peak_rss_bytes", "-"), ("GPU", "peak_device_bytes", "--")):
            known = [arm for arm in arms if all(getattr(run, field) is not None for run in arm.runs)]
            if known:
                y = [fmean(getattr(run, field) for run in arm.runs) / MIB for arm in known]
                plot(axes, [arm.gaussians for arm in known], y, method, linestyle=line)
                ended = ", then out of memory" if method in {left.method for left in results.left_out} else ""
                label = f"{method}, {name}{ended if name == 'GPU' else ''}"
                ends[label], colors[label] = (known[-1].gaussians, y[-1]), COLORS[method]
    if bases := [run.memory.base_rss_bytes / MIB for run in results.runs if run.memory is not None]:
        axes.axhline(min(bases), color="#888888", linewidth=0.8, linestyle=":")
        look = {"xycoords": ("axes fraction", "data"), "color": "#666666"}
        write_beside(axes, "RAM before any scene", (0.02, min(bases)), (0, -10), **look)
    axes.set(xlabel="Gaussians in the scene at the end", ylabel="peak memory (MiB)", ylim=(0, None))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: short(value)))
    lay_grid(axes)
    label_ends(axes, ends, 1.01 * axes.get_xlim()[1], colors, lambda name, _: name)
    return figure
