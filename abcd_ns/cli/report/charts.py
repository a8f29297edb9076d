"""The charts over time of one run, in the style of all others; a page shows them side by side."""

from collections.abc import Callable, Sequence
from itertools import pairwise
from statistics import fmean, median

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import FuncFormatter, MaxNLocator, MultipleLocator

from abcd_ns.cli.report.story import Story, Visit
from abcd_ns.lab.results.style import COLORS, in_style, label_ends, lay_grid, short
from abcd_ns.units import GIB, bytes_in_words

WIDTH, HEIGHT = 4.9, 2.7
"""Inches. Narrow, so that letters can still be read where a page is as wide as a phone."""
LEFT, RIGHT, TOP, BOTTOM = 0.62, 1.15, 0.12, 0.48
"""Margins, inches; the same in all charts, so that their times lie below each other."""
ROW, LEAST, LARGEST = 0.19, 0.7, 4.2
"""Of the time line, inches: a block's height, that of all together at least, and of the chart at most."""
SMOOTHED = 0.06
"""Share of the samples that each point of a smoothed line is the mean of."""
MANY_BLOCKS = 12
"""With more, lines bear no numbers."""
TRAINING, STEPS, LAYERS, QUIET = "#767676", "#0072b2", "#d55e00", "#767676"
BUDGETS = ("#0072b2", "#8a5a83", "#007a5a", "#d55e00")


@in_style
def draw_quality(story: Story, measured: tuple[int, float] | None, method: str) -> Figure | None:
    """PSNR over training time: of training crops, and of held-out views where they were looked at.

    Args:
        measured: the step of the checkpoint, and held-out PSNR (dB) as it was measured for the report.
    """
    scored = {line.step: (line.seconds, line.psnr) for line in story.held_out}
    if measured is not None:
        scored[measured[0]] = (story.seconds_at(measured[0]), measured[1])
    held_out = sorted(scored.values())
    crops = [(line.seconds, line.psnr) for line in story.samples if line.psnr is not None]
    if not held_out and not crops:
        return None
    figure, axes = _axes(story, "PSNR (dB)")
    ends, colors = {}, {"held out": COLORS.get(method, STEPS), "training": TRAINING}
    if crops:
        axes.plot(*zip(*crops, strict=True), ".", color=TRAINING, markersize=2.5, alpha=0.5)
        ends["training"] = _line(axes, smoothed(crops), TRAINING, linewidth=1.2)
    if held_out:
        options = {"marker": "o", "markersize": 4.5, "markeredgecolor": "#ffffff", "markeredgewidth": 0.5}
        ends["held out"] = _line(axes, held_out, colors["held out"], linewidth=1.6, **options)
    axes.margins(y=0.08)
    _label(axes, story, ends, colors, lambda name, psnr: f"{name}\n{psnr:.2f} dB")
    return figure


@in_style
def draw_visits(story: Story) -> Figure | None:
    """Which block was trained when; the part of each visit that went into layers stands out.

    Each bar's gid is `visit-NUMBER`.
    """
    if not story.visits:
        return None
    figure, axes = _axes(story, "block", min(BOTTOM + TOP + max(ROW * (story.blocks + 1), LEAST), LARGEST))
    for visit in story.visits:
        _draw_visit(axes, visit, story.blocks)
    for line in story.sweeps:
        axes.axvline(line.seconds, color=QUIET, linewidth=0.9, linestyle=(0, (1, 2)), zorder=0)
    axes.set_ylim(story.blocks + 0.6, 0.4)
    axes.yaxis.set_major_locator(MultipleLocator(max(1, -(-story.blocks // MANY_BLOCKS))))
    axes.grid(visible=False)
    for place, (color, text) in enumerate([(STEPS, "steps"), (LAYERS, "layers")]):
        axes.annotate(
            text, (1.03, 0.98 - 0.1 * place), xycoords="axes fraction", color=color, va="top", fontsize=8.5
        )
    return figure


@in_style
def draw_gaussians(story: Story) -> Figure | None:
    """Gaussians in the scene over time, with their limit if it is near."""
    points = [(line.seconds, line.gaussians) for line in (*story.trainings, *story.samples)]
    if len(points) < 2:
        return None
    figure, axes = _axes(story, "Gaussians")
    ends = {"Gaussians": _line(axes, sorted(points), STEPS)}
    limit = story.trainings[-1].limit
    if limit is not None and limit < 3 * max(count for _, count in points):
        axes.axhline(limit, color=LAYERS, linewidth=1, linestyle=(0, (4, 3)))
        ends["limit"] = (story.seconds, limit)
    axes.set_ylim(bottom=0)
    axes.margins(y=0.1)
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: short(value)))
    _label(axes, story, ends, {"Gaussians": STEPS, "limit": LAYERS}, lambda name, n: f"{short(n)}\n{name}")
    return figure


@in_style
def draw_memory(story: Story) -> Figure | None:
    """RAM of the process and memory on the device, over time."""
    on_gpu = [line for line in story.samples if line.device_bytes is not None]
    series = {
        "RAM": [(line.seconds, line.rss_bytes / GIB) for line in story.samples],
        "GPU": [(line.seconds, line.device_bytes / GIB) for line in on_gpu],
    }
    colors = {"RAM": STEPS, "GPU": LAYERS}
    return _draw_series(story, series, colors, "memory (GiB)", lambda name, y: f"{name}\n{y:.2f} GiB")


@in_style
def draw_budgets(story: Story) -> Figure | None:
    """What is kept at hand, as a share of its budget, over time."""
    budgets = {name: budget for name, budget in story.trainings[-1].budgets.items() if budget > 0}
    series = {
        name: [(line.seconds, 100 * line.held[name] / budget) for line in story.samples if name in line.held]
        for name, budget in budgets.items()
    }
    colors = {name: BUDGETS[place % len(BUDGETS)] for place, name in enumerate(budgets)}

    def write(name: str, share: float) -> str:
        return f"{name}\n{share:.0f}% of {bytes_in_words(budgets[name])}"

    return _draw_series(story, series, colors, "of its budget (%)", write, high=100)


@in_style
def draw_block_quality(story: Story) -> Figure | None:
    """PSNR on training crops, by block, at the end of each visit."""
    blocks = {
        block: [(visit.ended, visit.psnr) for visit in story.of_block(block) if visit.psnr is not None]
        for block in range(story.blocks)
    }
    known = {block: points for block, points in blocks.items() if points}
    if story.blocks < 2 or not known:
        return None
    figure, axes = _axes(story, "PSNR on training crops (dB)")
    few = len(known) <= MANY_BLOCKS
    for points in known.values():
        _line(axes, points, STEPS if few else QUIET, linewidth=1.0 if few else 0.5, alpha=0.75, marker=".")
    axes.margins(y=0.08)
    if few:
        for block, points in known.items():
            beside = {"xytext": (5, 0), "textcoords": "offset points", "va": "center"}
            axes.annotate(str(block + 1), points[-1], color=STEPS, annotation_clip=False, **beside)
    else:
        _label_median(axes, story, list(known.values()))
    return figure


def smoothed(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Running means: each point is that of its neighbours, as many on either side."""
    reach = int(len(points) * SMOOTHED / 2)
    found = []
    for place, (x, _) in enumerate(points):
        here = min(reach, place, len(points) - 1 - place)
        found.append((x, fmean(y for _, y in points[place - here : place + here + 1])))
    return found


def _axes(story: Story, what: str, height: float = HEIGHT) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(WIDTH, height))
    size = (WIDTH - LEFT - RIGHT) / WIDTH, (height - TOP - BOTTOM) / height
    axes = figure.add_axes((LEFT / WIDTH, BOTTOM / height, *size))
    axes.set_xlabel("training time (s)")
    axes.set_ylabel(what)
    axes.set_xlim(0, max(story.seconds, 1e-3))
    axes.xaxis.set_major_locator(MaxNLocator(6))
    axes.yaxis.set_major_locator(MaxNLocator(6))
    lay_grid(axes)
    for line in story.trainings[1:]:
        axes.axvline(line.seconds, color=QUIET, linewidth=0.8, linestyle=(0, (4, 3)), zorder=0)
    return figure, axes


def _line(axes: Axes, points: Sequence[tuple[float, float]], color: str, **options) -> tuple[float, float]:
    axes.plot(*zip(*points, strict=True), color=color, **{"linewidth": 1.4, **options})
    return points[-1]


def _draw_visit(axes: Axes, visit: Visit, blocks: int) -> None:
    """One bar in its block's row; the warm-up trains all of them."""
    top, height = (0.6, blocks - 0.2) if visit.block is None else (visit.block + 0.6, 0.8)
    color = QUIET if visit.block is None else STEPS
    bar = Rectangle((visit.began, top), visit.seconds, height, color=color, linewidth=0)
    bar.set_alpha(0.35 if visit.block is None else 0.85 if visit.done else 0.5)
    bar.set_gid(f"visit-{visit.number}")
    axes.add_patch(bar)
    if visit.layer_seconds > 0:
        axes.add_patch(Rectangle((visit.began, top), visit.layer_seconds, height, color=LAYERS, linewidth=0))
    if visit.block is None:
        middle = (visit.began + visit.seconds / 2, 0.5 + blocks / 2)
        axes.annotate("warm-up", middle, ha="center", va="center", fontsize=8, rotation=90)


def _draw_series(
    story: Story,
    series: dict[str, list[tuple[float, float]]],
    colors: dict[str, str],
    what: str,
    write: Callable[[str, float], str],
    high: float = 1e-3,
) -> Figure | None:
    """A line for each series, from 0 up to `high` at least."""
    known = {name: points for name, points in series.items() if points}
    if not known:
        return None
    figure, axes = _axes(story, what)
    ends = {name: _line(axes, points, colors[name]) for name, points in known.items()}
    axes.set_ylim(0, max(1.1 * max(y for points in known.values() for _, y in points), high))
    _label(axes, story, ends, colors, write)
    return figure


def _label(
    axes: Axes,
    story: Story,
    ends: dict[str, tuple[float, float]],
    colors: dict[str, str],
    write: Callable[[str, float], str],
) -> None:
    """Each line's end, in two lines of text."""
    label_ends(axes, ends, 1.03 * max(story.seconds, 1e-3), colors, write, gap=0.17)


def _label_median(axes: Axes, story: Story, blocks: Sequence[Sequence[tuple[float, float]]]) -> None:
    """The median of all blocks' last values at each end of a sweep, in place of numbers."""
    moments = [0.0, *(line.seconds for line in story.sweeps), story.seconds]
    points = []
    for since, until in pairwise(moments):
        values = [y for block in blocks for x, y in block if since < x <= until]
        if values:
            points.append((until, median(values)))
    if points:
        end = _line(axes, points, STEPS, linewidth=1.8)
        _label(axes, story, {"median": end}, {"median": STEPS}, lambda name, psnr: f"{name}\n{psnr:.1f} dB")


def visit_titles(story: Story) -> dict[str, str]:
    """What a pointer on a visit's bar is told, by the bar's gid."""
    return {f"visit-{visit.number}": _in_words(visit) for visit in story.visits}


def _in_words(visit: Visit) -> str:
    if visit.block is None:
        return f"warm-up of the whole scene, {visit.seconds:.1f} s"
    share = visit.layer_seconds / visit.seconds if visit.seconds > 0 else 0.0
    quality = "" if visit.psnr is None else f", {visit.psnr:.2f} dB"
    unfinished = "" if visit.done else ", not finished"
    return (
        f"block {visit.block + 1}, sweep {visit.sweep}: {visit.seconds:.1f} s from {visit.began:.1f} s on, "
        f"{share:.0%} of it for layers{quality}{unfinished}"
    )
