"""The chart of `abcd scale`: memory and time against the size of the scene."""

from pathlib import Path

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from abcd_ns.lab.runs.style import COLORS, MARKERS, STYLE, lay_grid, save
from abcd_ns.lab.runs.tables import MIB
from abcd_ns.lab.scale.arm import Arm
from abcd_ns.lab.scale.results import ScaleResults

NAMES = {False: "abcd", True: "abcd-monolithic"}


def draw(results: ScaleResults, out: Path) -> list[Path]:
    """Write scale.png and scale.svg; returns their paths. Nothing without a measurement."""
    if not results.arms:
        return []
    with matplotlib.rc_context(STYLE):
        has_gpu = any(arm.peak_device_bytes for arm in results.arms)
        figure = Figure(figsize=(7.2, 3.2), layout="constrained")
        memory, time = figure.subplots(1, 2)
        _draw_memory(memory, results, has_gpu)
        _draw_time(time, results)
        return save(figure, out, "scale")


def _draw_memory(axes: Axes, results: ScaleResults, has_gpu: bool) -> None:
    for monolithic, name in NAMES.items():
        arms = results.of(monolithic)
        if not arms:
            continue
        x = [arm.gaussians for arm in arms]
        style = {"color": COLORS[name], "marker": MARKERS[name], "markersize": 4, "linewidth": 1.3}
        axes.plot(x, [_ram(arm) for arm in arms], **style)
        label = "one block" if monolithic else "ABCD"
        last = arms[-1]
        axes.annotate(
            f"{label}, RAM",
            (last.gaussians, _ram(last)),
            xytext=(0, 7),
            textcoords="offset points",
            ha="right",
            color=COLORS[name],
        )
        if has_gpu:
            device = [(arm.peak_device_bytes or 0) / MIB for arm in arms]
            axes.plot(x, device, linestyle="--", **style)
            ended = ", then out of memory" if monolithic and results.one_block_too_large else ""
            axes.annotate(
                f"{label}, GPU{ended}",
                (last.gaussians, device[-1]),
                xytext=(0, -12),
                textcoords="offset points",
                ha="right",
                color=COLORS[name],
            )
    base = min(arm.base_rss_bytes for arm in results.arms) / MIB
    axes.axhline(base, color="#888888", linewidth=0.8, linestyle=":")
    axes.annotate(
        "RAM before any scene",
        (0.98, base),
        xycoords=("axes fraction", "data"),
        xytext=(0, -10),
        textcoords="offset points",
        ha="right",
        color="#666666",
        fontsize=8,
    )
    axes.set_ylim(bottom=0)
    axes.set_ylabel("peak memory (MiB)")
    _size_axis(axes, results)


def _draw_time(axes: Axes, results: ScaleResults) -> None:
    arms = [arm for arm in results.of(monolithic=False) if arm.visit_seconds is not None]
    x = [arm.gaussians for arm in arms]
    style = {"color": COLORS["abcd"], "marker": MARKERS["abcd"], "markersize": 4, "linewidth": 1.3}
    axes.plot(x, [arm.visit_seconds for arm in arms], **style)
    axes.plot(
        x, [arm.layer_seconds for arm in arms], **{**style, "linestyle": "--", "markerfacecolor": "white"}
    )
    if arms:
        for value, text in ((arms[-1].visit_seconds, "a visit"), (arms[-1].layer_seconds, "of it, layers")):
            axes.annotate(
                text,
                (x[-1], value),
                xytext=(0, 7),
                textcoords="offset points",
                ha="right",
                color=COLORS["abcd"],
            )
    axes.set_ylim(bottom=0)
    axes.margins(y=0.15)
    axes.set_ylabel("seconds")
    _size_axis(axes, results)


def _size_axis(axes: Axes, results: ScaleResults) -> None:
    axes.set_xscale("log", base=2)
    axes.xaxis.set_major_locator(FixedLocator(sorted({arm.gaussians for arm in results.arms})[::2]))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: _short(value)))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.set_xlabel("Gaussians in the scene")
    lay_grid(axes)


def _ram(arm: Arm) -> float:
    return arm.peak_rss_bytes / MIB


def _short(number: float) -> str:
    return f"{number / 1e6:.3g} M" if number >= 1e6 else f"{number / 1e3:.3g} k"
