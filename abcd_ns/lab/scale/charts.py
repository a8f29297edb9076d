"""The chart of `abcd scale`: memory and time against the size of the scene."""

from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from abcd_ns.lab.results.results import Results
from abcd_ns.lab.results.style import (
    COLORS,
    in_style,
    label_ends,
    lay_grid,
    plot,
    save,
    short,
    tick_at,
    write_beside,
)
from abcd_ns.units import MIB

NAMES = {"abcd": "ABCD", "abcd-monolithic": "one block"}


@in_style
def draw_scale(results: Results, out: Path) -> list[Path]:
    """Write scale.png and scale.svg; returns their paths. Nothing without a measurement."""
    if not results.arms:
        return []
    figure = Figure(figsize=(8.4, 3.2), layout="constrained")
    memory, time = figure.subplots(1, 2, width_ratios=(1.25, 1))
    ends: dict[str, tuple[float, float]] = {}
    for method in results.methods:
        ends |= _draw_memory(memory, results, method)
    base = min(run.memory.base_rss_bytes for run in results.runs) / MIB
    memory.axhline(base, color="#888888", linewidth=0.8, linestyle=":")
    look = {"xycoords": ("axes fraction", "data"), "ha": "left", "color": "#666666"}
    write_beside(memory, "RAM before any scene", (0.02, base), (0, -10), **look)
    memory.set_ylabel("peak memory (MiB)")
    _draw_time(time, results)
    time.margins(y=0.15)
    time.set_ylabel("seconds")
    every = sorted({run.gaussians for run in results.runs})
    sizes = every if len(every) < 4 else every[::2]
    for axes in (memory, time):
        axes.set_ylim(bottom=0)
        tick_at(axes, sizes, short)
        axes.set_xlabel("Gaussians in the scene")
        lay_grid(axes)
    colors = {name: COLORS[method] for method in results.methods for name in ends if NAMES[method] in name}
    label_ends(memory, ends, every[-1] * (every[-1] / every[0]) ** 0.08, colors, lambda name, _: name)
    return save(figure, out, "scale")


def _draw_memory(axes: Axes, results: Results, method: str) -> dict[str, tuple[float, float]]:
    """Draw a method's curves; where each of them ends, by its name."""
    runs = [arm.runs[0] for arm in results.of(method)]
    x, ram = [run.gaussians for run in runs], [run.peak_rss_bytes / MIB for run in runs]
    plot(axes, x, ram, method, markersize=4)
    ends = {f"{NAMES[method]}, RAM": (x[-1], ram[-1])}
    if any(run.peak_device_bytes for run in results.runs):
        device = [(run.peak_device_bytes or 0) / MIB for run in runs]
        plot(axes, x, device, method, markersize=4, linestyle="--")
        ended = ", then out of memory" if method in {left.method for left in results.left_out} else ""
        ends[f"{NAMES[method]}, GPU{ended}"] = (x[-1], device[-1])
    return ends


def _draw_time(axes: Axes, results: Results) -> None:
    runs = [arm.runs[0] for arm in results.of("abcd") if arm.runs[0].memory.visit_seconds is not None]
    x = [run.gaussians for run in runs]
    layers = {"linestyle": "--", "markerfacecolor": "white"}
    for name, text, look in (("visit_seconds", "a visit", {}), ("layer_seconds", "of it, layers", layers)):
        seconds = [getattr(run.memory, name) for run in runs]
        plot(axes, x, seconds, "abcd", markersize=4, **look)
        if runs:
            look = {"ha": "right", "color": COLORS["abcd"], "fontsize": 9}
            write_beside(axes, text, (x[-1], seconds[-1]), (0, 7), **look)
