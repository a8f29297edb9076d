"""The studies' charts, one for each study, in the style of the comparison's."""

from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import fmean

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from abcd_ns.lab.results.findings import GOAL_DB, best_and_worst, find_differences
from abcd_ns.lab.results.frontier import LIMIT, MCMC, PRICE, curves
from abcd_ns.lab.results.results import Arm, Results, find_default
from abcd_ns.lab.results.run import Run
from abcd_ns.lab.results.style import (
    COLORS,
    in_style,
    label_ends,
    lay_grid,
    plot,
    save,
    scatter,
    short,
    tick_at,
    write_beside,
)
from abcd_ns.units import MIB

WAYS = {PRICE: ("#0072B2", "o"), LIMIT: ("#8A6A00", "s"), MCMC: ("#B3306B", "D")}
"""Colour and mark of each way to a number of Gaussians."""
BETTER, WORSE, SAME = "#007A5A", "#D55E00", "#666666"
ROW_INCHES, LINE_INCHES = 0.3, 0.17
CHANCE = 0.25
"""How far the axis of differences reaches at least, dB: what chance does must not fill the chart."""
COLUMN_POINTS = (40, 80, 140)
"""Where the numbers beside the bars end, from the axis."""
HALO = {"zorder": 5, "path_effects": [withStroke(linewidth=2.5, foreground="white")]}
"""Of what is written over lines."""
Value = Callable[[Run], float]


@in_style
def draw_study(results: Results, out: Path) -> list[Path]:
    """Write the study's chart as png and svg into `out`; returns their paths. Nothing without a run."""
    study = results.kind.removeprefix("study of ")
    draw = {"blocks": _draw_blocks, "gaussians": _draw_gaussians, "options": _draw_options}[study]
    figure = draw(results) if results.arms else None
    return [] if figure is None else save(figure, out, study)


# -- blocks ------------------------------------------------------------------------------------------


def _draw_blocks(results: Results) -> Figure:
    figure, arms = Figure(figsize=(7.2, 3.6), layout="constrained"), results.arms
    grid = figure.add_gridspec(3, 2, width_ratios=(2.1, 1))
    main = figure.add_subplot(grid[:, 0])
    _draw_gap(main, arms)
    grey = {"color": "#888888", "marker": "D", "markersize": 3}
    handles = {"composited, block by block": _draw_line(main, arms, lambda run: run.psnr, **grey)}
    if any(len(arm.runs) > 1 for arm in arms):
        points = [(arm.value, run.psnr_merged) for arm in arms for run in arm.runs]
        scatter(main, *zip(*points, strict=True), COLORS[arms[0].method])
    handles["merged, as any viewer draws"] = _draw_line(main, arms, lambda run: run.psnr_merged)
    main.set_xlabel("blocks")
    main.set_ylabel("held-out PSNR (dB)")
    main.margins(y=0.12)
    main.set_title(_title(results, arms[0].method), loc="left")
    names = sorted(handles, reverse=True)
    main.legend([handles[name] for name in names], names, frameon=False, fontsize=8)
    for row, (title, value) in enumerate(_costs(results)):
        small = figure.add_subplot(grid[row, 1])
        _draw_line(small, arms, value, markersize=3.5)
        small.set_title(title, loc="left", fontsize=8)
        small.set_ylim(0, 1.15 * small.get_ylim()[1])
        small.yaxis.set_major_locator(MaxNLocator(3))
        small.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,g}"))
        small.tick_params(labelsize=7, labelbottom=row == 2)
    small.set_xlabel("blocks")
    return figure


def _costs(results: Results) -> list[tuple[str, Value]]:
    """What a number of blocks costs, each with its title."""
    spent = ("steps", lambda run: run.steps)
    if results.settings.seconds is None:
        spent = ("training (s)", lambda run: run.train_seconds)
    memory = ("peak RAM (GiB)", lambda run: run.peak_rss_bytes / 2**30)
    if all(run.peak_device_bytes is not None for run in results.runs):
        memory = ("peak GPU memory (GiB)", lambda run: run.peak_device_bytes / 2**30)
    return [("Gaussians", lambda run: run.gaussians), spent, memory]


def _draw_gap(axes: Axes, arms: Sequence[Arm]) -> None:
    """The band in which all must lie, and what best and worst are apart."""
    found = best_and_worst(arms)
    if found is None:
        return
    best, worst = found
    goal, left, right = best.psnr - GOAL_DB, arms[0], arms[-1]
    axes.axhspan(goal, best.psnr, color="#ececec", zorder=0, linewidth=0)
    at_right = abs(right.psnr - goal) > abs(left.psnr - goal)  # where the line is farther away
    look = {"xycoords": ("axes fraction", "data"), "va": "bottom", "fontsize": 7, "color": "#777777"}
    place, side = (0.99, "right") if at_right else (0.01, "left")
    write_beside(axes, f"best - {GOAL_DB:g} dB", (place, goal), (0, 2), ha=side, **look)
    for arm, word, above in ((best, "best", 9), (worst, "worst", -16)):
        shift, side = (-4, "left") if arm is left else (4, "right") if arm is right else (0, "center")
        at, color = (arm.value, arm.psnr), COLORS[arm.method]
        write_beside(axes, f"{word} {arm.psnr:.2f}", at, (shift, above), ha=side, color=color, **HALO)


def _draw_line(axes: Axes, arms: Sequence[Arm], value: Value, **look) -> Line2D:
    """Means over the seeds, by the number of blocks."""
    heights = [fmean(value(run) for run in arm.runs) for arm in arms]
    line = plot(axes, [arm.value for arm in arms], heights, arms[0].method, **{"marker": "o", **look})
    tick_at(axes, [arm.value for arm in arms], lambda value: f"{value:g}")
    lay_grid(axes)
    return line


# -- Gaussians ---------------------------------------------------------------------------------------


def _draw_gaussians(results: Results) -> Figure:
    """PSNR against the number of Gaussians and, where it is known, against the size of their .spz."""
    sizes: list[tuple[str, Value, Callable[[float], str]]] = [
        ("Gaussians at the end", lambda run: run.gaussians, short)
    ]
    if all(run.spz_bytes is not None for run in results.runs):
        sizes.append(("MiB as .spz", lambda run: run.spz_bytes / MIB, "{:.3g}".format))
    figure = Figure(figsize=(2.6 + 4.0 * len(sizes), 3.7), layout="constrained")
    panels = figure.subplots(1, len(sizes), sharey=True, squeeze=False)[0]
    for axes, (label, size, write) in zip(panels, sizes, strict=True):
        ends = {way: _draw_way(axes, way, arms, size) for way, arms in curves(results).items()}
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _, write=write: write(value)))
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.margins(x=0.08, y=0.15)
        if (default := find_default(results)) is not None:
            _mark_stop(axes, default, fmean(map(size, default.runs)), write)
        axes.yaxis.set_major_locator(MaxNLocator(7))
        axes.set_xlabel(label)
        lay_grid(axes)
    panels[0].set_ylabel("held-out PSNR (dB)")
    panels[0].set_title(f"{_title(results, results.methods[0])}\nstar: where it stops by itself", loc="left")
    right = axes.get_xlim()[1] * 1.06
    label_ends(axes, ends, right, {way: color for way, (color, _) in WAYS.items()}, lambda way, _: way)
    return figure


def _draw_way(axes: Axes, way: str, arms: Sequence[Arm], size: Value) -> tuple[float, float]:
    """One curve, and a dot for each seed where there are several; returns its end."""
    color, marker = WAYS[way]
    if any(len(arm.runs) > 1 for arm in arms):
        points = [(size(run), run.psnr_merged) for arm in arms for run in arm.runs]
        scatter(axes, *zip(*points, strict=True), color)
    x, y = [fmean(map(size, arm.runs)) for arm in arms], [arm.psnr for arm in arms]
    plot(axes, x, y, arms[0].method, color=color, marker=marker)
    return x[-1], y[-1]


def _mark_stop(axes: Axes, arm: Arm, size: float, write: Callable[[float], str]) -> None:
    color, at = WAYS[PRICE][0], (size, arm.psnr)
    axes.plot(*at, "*", markersize=15, color=color, markeredgecolor="white", zorder=4)
    text = f"{write(size)}, {arm.psnr:.2f} dB"
    write_beside(axes, text, at, (-6, 9), ha="right", color=color, **HALO)


# -- options -----------------------------------------------------------------------------------------


def _draw_options(results: Results) -> Figure | None:
    default = find_default(results)
    rows = sorted(find_differences(results), key=lambda pair: pair[1].mean)
    if not rows:
        return None
    lines = max(len(arm.variant.split()) for arm, _ in rows)
    height = max(ROW_INCHES, LINE_INCHES * lines)
    figure = Figure(figsize=(7.2, 1.25 + height * len(rows)), layout="constrained")
    axes = figure.add_subplot()
    axes.use_sticky_edges = False  # bars that end at 0 leave room beyond it
    axes.axvline(0, color="#444444", linewidth=0.9)
    _write_columns(axes, len(rows) - 0.35, ("change", "PSNR", "Gaussians"), "#444444")
    for row, (arm, difference) in enumerate(rows):
        noise = difference.deviation or 0.0
        color = SAME if abs(difference.mean) <= noise else BETTER if difference.mean > 0 else WORSE
        axes.barh(row, difference.mean, height=0.56, color=color, alpha=0.85, linewidth=0)
        if len(difference.by_seed) > 1:
            axes.scatter(difference.by_seed, [row] * len(difference.by_seed), s=8, color="#222222", zorder=3)
        texts = (f"{difference.mean:+.2f}", f"{arm.psnr:.2f}", f"{arm.gaussians:,.0f}")
        _write_columns(axes, row, texts, color)
    axes.set_yticks(range(len(rows)), [arm.variant.replace(" ", "\n") for arm, _ in rows])
    axes.tick_params(axis="y", length=0)
    axes.spines["left"].set_visible(False)
    axes.set_ylim(-0.6, len(rows) - 0.1)
    axes.margins(x=0.08)
    low, high = axes.get_xlim()
    axes.set_xlim(min(low, -CHANCE), max(high, CHANCE))
    dots = "; dots: seeds" if len(default.runs) > 1 else ""
    axes.set_xlabel(f"held-out PSNR against the default's (dB){dots}")
    axes.set_title(f"{_title(results, default.method)}\ndefault: {default.psnr:.2f} dB", loc="left")
    lay_grid(axes)
    axes.grid(visible=False, axis="y")
    return figure


def _write_columns(axes: Axes, row: float, texts: Sequence[str], color: str) -> None:
    look = {"xycoords": ("axes fraction", "data"), "ha": "right", "va": "center", "color": color}
    for text, place in zip(texts, COLUMN_POINTS, strict=True):
        write_beside(axes, text, (1, row), (place, 0), **look)


def _title(results: Results, method: str | None = None) -> str:
    s = results.settings
    parts = [s.scene, f"1/{s.downscale} size", *([method] if method else [])]
    if results.kind != "study of blocks" and set(results.methods) != {"abcd-monolithic"}:
        parts.append(f"{s.blocks} blocks")
    parts.append(s.budget)
    if results.means_of:
        parts.append(results.means_of)
    return ", ".join(parts)
