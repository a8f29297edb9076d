"""The studies' charts, one for each study, in the style of the comparison's."""

from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import fmean

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullLocator

from abcd_ns.lab.runs.run import Run
from abcd_ns.lab.runs.style import COLORS, MARKERS, STYLE, label_ends, lay_grid, save
from abcd_ns.lab.study.findings import (
    GOAL_DB,
    KNEE_DB,
    find_default,
    find_difference,
    find_gap,
    find_knee,
)
from abcd_ns.lab.study.results import Arm, StudyResults

BAND = "#ececec"
KNEE_LINE = 0.065
"""Height of a line of text, as a share of the axis' height."""
BETTER, WORSE, SAME = "#007A5A", "#D55E00", "#666666"
ROW_INCHES, LINE_INCHES = 0.3, 0.17
CHANCE = 0.25
"""How far the axis of differences reaches at least, dB: what chance does must not fill the chart."""
COLUMNS = ("change", "PSNR", "Gaussians")
"""Numbers beside the bars, right-aligned at COLUMN_POINTS from the axis."""
COLUMN_POINTS = (40, 80, 140)
Value = Callable[[Run], float]


def draw_study(results: StudyResults, out: Path) -> list[Path]:
    """Write the study's chart as png and svg into `out`; returns their paths. Nothing without a run."""
    draw = {"blocks": _draw_blocks, "gaussians": _draw_gaussians, "options": _draw_options}[results.study]
    with matplotlib.rc_context(STYLE):
        figure = draw(results)
        return [] if figure is None else save(figure, out, results.study)


# -- blocks ------------------------------------------------------------------------------------------


def _draw_blocks(results: StudyResults) -> Figure | None:
    if not results.arms:
        return None
    figure = Figure(figsize=(7.2, 3.6), layout="constrained")
    grid = figure.add_gridspec(3, 2, width_ratios=(2.1, 1))
    main = figure.add_subplot(grid[:, 0])
    color = COLORS[results.arms[0].method]
    _draw_gap(main, results.arms)
    ends = {
        "composited": _draw_line(
            main, results.arms, lambda run: run.psnr, color="#888888", marker="D", size=3
        ),
        "merged": _draw_line(main, results.arms, lambda run: run.psnr_merged, color=color, seeds=True),
    }
    _over_blocks(main, results.arms)
    main.set_xlabel("blocks")
    main.set_ylabel("held-out PSNR (dB)")
    main.margins(y=0.12)
    main.set_title(_title(results, results.arms[0].method), loc="left")
    handles = [main.lines[-1], ends["composited"]]
    main.legend(
        handles, ["merged, as any viewer draws", "composited, block by block"], frameon=False, fontsize=8
    )
    for row, (title, value) in enumerate(_costs(results)):
        small = figure.add_subplot(grid[row, 1])
        _draw_line(small, results.arms, value, color=color, size=3.5)
        _over_blocks(small, results.arms)
        small.set_title(title, loc="left", fontsize=8)
        small.set_ylim(0, 1.15 * small.get_ylim()[1])
        small.yaxis.set_major_locator(MaxNLocator(3))
        small.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,g}"))
        small.tick_params(labelsize=7, labelbottom=row == 2)
    small.set_xlabel("blocks")
    return figure


def _costs(results: StudyResults) -> list[tuple[str, Value]]:
    """What a number of blocks costs, each with its title."""
    spent = ("steps", lambda run: run.steps)
    if results.protocol.seconds is None:
        spent = ("training (s)", lambda run: run.train_seconds)
    runs = [run for arm in results.arms for run in arm.runs]
    memory = ("peak RAM (GiB)", lambda run: run.peak_rss_bytes / 2**30)
    if all(run.peak_device_bytes is not None for run in runs):
        memory = ("peak GPU memory (GiB)", lambda run: run.peak_device_bytes / 2**30)
    return [("Gaussians", lambda run: run.gaussians), spent, memory]


def _draw_gap(axes: Axes, arms: Sequence[Arm]) -> None:
    """The band in which all must lie, and what best and worst are apart."""
    gap = find_gap(arms)
    if gap is None:
        return
    axes.axhspan(gap.best.psnr - GOAL_DB, gap.best.psnr, color=BAND, zorder=0, linewidth=0)
    at_right = arms[-1].psnr < arms[0].psnr  # where the line is farther below
    axes.annotate(
        f"best - {GOAL_DB:g} dB",
        xy=(0.99 if at_right else 0.01, gap.best.psnr - GOAL_DB),
        ha="right" if at_right else "left",
        xycoords=("axes fraction", "data"),
        xytext=(0, -2),
        textcoords="offset points",
        va="top",
        fontsize=7,
        color="#777777",
    )
    left, right = arms[0], arms[-1]
    for arm, word, offset in ((gap.best, "best", 9), (gap.worst, "worst", -16)):
        label = axes.annotate(
            f"{word} {arm.psnr:.2f}",
            xy=(arm.value, arm.psnr),
            xytext=(-4 if arm is left else 4 if arm is right else 0, offset),
            textcoords="offset points",
            ha="left" if arm is left else "right" if arm is right else "center",
            fontsize=8,
            color=COLORS[arm.method],
            zorder=5,
        )
        label.set_path_effects([withStroke(linewidth=2.5, foreground="white")])


def _draw_line(
    axes: Axes,
    arms: Sequence[Arm],
    value: Value,
    *,
    color: str,
    marker: str = "o",
    size: float = 5.0,
    seeds: bool = False,
):
    """Means over the seeds, by the arms' values; with `seeds`, each seed as a small dot. Returns the line."""
    if seeds and any(len(arm.runs) > 1 for arm in arms):
        points = [(arm.value, value(run)) for arm in arms for run in arm.runs]
        axes.scatter(*zip(*points, strict=True), s=9, color=color, alpha=0.4, linewidths=0)
    heights = [fmean(value(run) for run in arm.runs) for arm in arms]
    (line,) = axes.plot(
        [arm.value for arm in arms],
        heights,
        color=color,
        marker=marker,
        markersize=size,
        markeredgecolor="white",
        markeredgewidth=0.5,
        linewidth=1.4,
    )
    return line


def _over_blocks(axes: Axes, arms: Sequence[Arm]) -> None:
    axes.set_xscale("log", base=2)
    axes.xaxis.set_major_locator(FixedLocator([arm.value for arm in arms]))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    lay_grid(axes)


# -- Gaussians ---------------------------------------------------------------------------------------


def _draw_gaussians(results: StudyResults) -> Figure | None:
    if not results.arms:
        return None
    figure = Figure(figsize=(6.2, 3.7), layout="constrained")
    axes = figure.add_subplot()
    ends = {}
    for method in results.methods:
        arms = results.of(method)
        color = COLORS[method]
        if any(len(arm.runs) > 1 for arm in arms):
            points = [(run.gaussians, run.psnr_merged) for arm in arms for run in arm.runs]
            axes.scatter(*zip(*points, strict=True), s=9, color=color, alpha=0.4, linewidths=0)
        axes.plot(
            [arm.gaussians for arm in arms],
            [arm.psnr for arm in arms],
            color=color,
            marker=MARKERS[method],
            markersize=5,
            markeredgecolor="white",
            markeredgewidth=0.5,
            linewidth=1.4,
        )
        ends[method] = (arms[-1].gaussians, arms[-1].psnr)
    axes.set_xscale("log")
    axes.margins(x=0.06, y=0.15)
    # The largest limit stays in sight, unless growth ended far below it.
    reached, largest = (max(get(arm) for arm in results.arms) for get in (_end, _limit))
    axes.set_xlim(right=max(axes.get_xlim()[1], 1.1 * min(largest, 1.6 * reached)))
    low, high = axes.get_ylim()
    axes.set_ylim(low - KNEE_LINE * len(results.methods) * (high - low), high)  # room for the knees' names
    for row, method in enumerate(results.methods):
        _mark_knee(axes, results.of(method), row)
    counts = sorted({arm.value for arm in results.arms})
    axes.xaxis.set_major_locator(FixedLocator(counts))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: _short(value)))
    axes.yaxis.set_major_locator(MaxNLocator(7))
    axes.set_xlabel("Gaussians at the end (marked: the limits)")
    axes.set_ylabel("held-out PSNR (dB)")
    axes.set_title(
        _title(results) + f"\nring: knee, the fewest within {KNEE_DB:g} dB of the best", loc="left"
    )
    lay_grid(axes)
    label_ends(axes, ends, 1.04 * axes.get_xlim()[1])
    return figure


def _end(arm: Arm) -> float:
    return arm.gaussians


def _limit(arm: Arm) -> int:
    return arm.value


def _mark_knee(axes: Axes, arms: Sequence[Arm], row: int) -> None:
    """A ring around the knee, a line down to its number, in the method's colour."""
    knee = find_knee(arms)
    if knee is None:
        return
    color, (low, high) = COLORS[knee.method], axes.get_ylim()
    axes.plot(knee.gaussians, knee.psnr, "o", markersize=12, markerfacecolor="none", markeredgecolor=color)
    axes.vlines(knee.gaussians, low, knee.psnr, color=color, linewidth=0.8, linestyle=(0, (3, 3)), zorder=1)
    axes.set_ylim(low, high)
    far = axes.transAxes.inverted().transform(axes.transData.transform((knee.gaussians, low)))[0] > 0.8
    axes.annotate(
        f"knee {_short(knee.gaussians)}",
        xy=(knee.gaussians, 0.02 + KNEE_LINE * row),
        xycoords=("data", "axes fraction"),
        xytext=(-4 if far else 4, 0),
        textcoords="offset points",
        ha="right" if far else "left",
        color=color,
        fontsize=8,
    )


def _short(count: float) -> str:
    """32000 as 32k."""
    if count >= 1e6:
        return f"{count / 1e6:.3g}M"
    return f"{count / 1e3:.3g}k" if count >= 1000 else f"{count:.0f}"


# -- options -----------------------------------------------------------------------------------------


def _draw_options(results: StudyResults) -> Figure | None:
    default = find_default(results)
    if default is None:
        return None
    found = [(arm, find_difference(arm, default)) for arm in results.arms if arm is not default]
    rows = sorted(((a, d) for a, d in found if d is not None), key=lambda pair: pair[1].mean)
    if not rows:
        return None
    lines = max(len(arm.variant.split()) for arm, _ in rows)
    height = max(ROW_INCHES, LINE_INCHES * lines)
    figure = Figure(figsize=(7.2, 1.25 + height * len(rows)), layout="constrained")
    axes = figure.add_subplot()
    axes.use_sticky_edges = False  # bars that end at 0 leave room beyond it
    axes.axvline(0, color="#444444", linewidth=0.9)
    _write_columns(axes, len(rows) - 0.35, COLUMNS, "#444444")
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
    for text, place in zip(texts, COLUMN_POINTS, strict=True):
        axes.annotate(
            text,
            xy=(1, row),
            xycoords=("axes fraction", "data"),
            xytext=(place, 0),
            textcoords="offset points",
            ha="right",
            va="center",
            fontsize=8,
            color=color,
        )


def _title(results: StudyResults, method: str | None = None) -> str:
    p = results.protocol
    parts = [p.scene, f"1/{p.downscale} size", *([method] if method else [])]
    if results.study != "blocks":
        parts.append(f"{p.blocks} blocks")
    parts.append(f"{p.steps:,} steps" if p.seconds is None else f"{p.seconds:g} s")
    if len(p.seeds) > 1:
        parts.append(f"mean of {len(p.seeds)} seeds")
    return ", ".join(parts)
