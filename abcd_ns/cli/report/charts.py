"""The charts of one run, as SVG images that stand in the page."""

from collections.abc import Sequence
from io import BytesIO

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import EngFormatter, MaxNLocator
from nerfstudio.cameras.cameras import Cameras

from abcd_ns.cli.report.run_folder import Checkpoint
from abcd_ns.cli.report.story import Story
from abcd_ns.lab.results.style import COLORS, in_style, lay_grid
from abcd_ns.nerfstudio.run.log_lines import SampleLine, TrainingLine
from abcd_ns.units import GIB
from abcd_ns.viewer.images import data_uri

WIDTH, HEIGHT = 8.0, 2.6  # inches
SMOOTHED = 0.06  # share of the samples that each point of a smoothed line is the mean of
STEPS, LAYERS, QUIET = "#0072b2", "#d55e00", "#767676"
SHOWN = (0.03, 0.97)  # quantiles of the Gaussians between which a map reaches, and beyond where cameras are
BINS = 160


@in_style
def draw_quality(story: Story, measured: tuple[int, float] | None, method: str) -> str | None:
    """PSNR over training time: of held-out views where they were drawn, and of training crops. `measured` is
    the step of the checkpoint, and held-out PSNR (dB) as it was measured for the report."""
    scored = {line.step: (line.seconds, line.psnr) for line in story.held_out}
    if measured is not None:
        scored[measured[0]] = (story.seconds_at(measured[0]), measured[1])
    crops = [(line.seconds, line.psnr) for line in story.of(SampleLine) if line.psnr is not None]
    if not scored and not crops:
        return None
    figure = Figure(figsize=(WIDTH, HEIGHT), layout="constrained")
    axes = _over_time(figure.subplots(), story, "PSNR (dB)")
    if crops:
        points = np.array(crops).T
        axes.plot(*points, ".", color=QUIET, markersize=2.5, alpha=0.5)
        reach = max(int(len(crops) * SMOOTHED), 1)
        smooth = [np.convolve(row, np.ones(reach) / reach, "valid") for row in points]
        axes.plot(*smooth, color=QUIET, linewidth=1.2, label="training crops")
    if scored:
        style = {"color": COLORS.get(method, STEPS), "clip_on": False, "label": "held-out views"}
        axes.plot(*zip(*sorted(scored.values()), strict=True), "o-", **style)
    axes.legend(frameon=False, loc="lower right")
    return _uri(figure)


@in_style
def draw_progress(story: Story) -> str | None:
    """Visits, Gaussians and memory over training time, one below the other; None where nothing is known."""
    samples, panels = story.of(SampleLine), {}
    if samples:
        memory = {"RAM": [line.rss_bytes / GIB for line in samples]}
        if any(line.device_bytes is not None for line in samples):
            memory["GPU"] = [(line.device_bytes or 0) / GIB for line in samples]
        panels = {"Gaussians": {"in the scene": [line.gaussians for line in samples]}, "memory (GiB)": memory}
    rows = bool(story.visits) + len(panels)
    if not rows:
        return None
    figure = Figure(figsize=(WIDTH, HEIGHT * rows), layout="constrained")
    below = iter(figure.subplots(rows, squeeze=False)[:, 0])
    if story.visits:
        _draw_visits(next(below), story)
    for what, curves in panels.items():
        axes = _over_time(next(below), story, what)
        for (name, values), color in zip(curves.items(), (STEPS, LAYERS), strict=False):
            axes.plot([line.seconds for line in samples], values, color=color, label=name)
        axes.legend(loc="lower right")
        axes.set_ylim(bottom=0)
        if what == "Gaussians":
            axes.yaxis.set_major_formatter(EngFormatter(sep=""))
    return _uri(figure)


def _draw_visits(axes: Axes, story: Story) -> None:
    """Which block was trained when; each visit begins with drawing its layers. The warm-up is shaded."""
    _over_time(axes, story, "block").grid(visible=False)
    if (first := story.visits[0]).block is None:
        ends = first.seconds - first.visit_seconds, first.seconds
        axes.axvspan(*ends, color=STEPS, alpha=0.3, linewidth=0, label="warm-up")
    visits = [visit for visit in story.visits if visit.block is not None]
    rows = [visit.block + 1 for visit in visits]
    began = [visit.seconds - visit.visit_seconds for visit in visits]
    axes.barh(rows, [visit.visit_seconds for visit in visits], left=began, color=STEPS, label="steps")
    axes.barh(rows, [visit.layer_seconds for visit in visits], left=began, color=LAYERS, label="layers")
    axes.legend(frameon=False, loc="upper left", bbox_to_anchor=(1, 1))
    axes.set_ylim(story.blocks + 0.6, 0.4)
    axes.yaxis.set_major_locator(MaxNLocator(12, integer=True))


@in_style
def draw_map(checkpoint: Checkpoint, cameras: Sequence[Cameras]) -> str:
    """The blocks from above, and from the side where some lie above others. `cameras` are those trained on,
    and those held out; none where the data is gone."""
    tree, means = checkpoint.tree, checkpoint.means.double().numpy()
    centers = [found.camera_to_worlds[:, :3, 3].cpu().double().numpy() for found in cameras]
    planes = [(0, 1), (0, 2)] if any(axis == 2 for axis, *_ in tree.rows) else [(0, 1)]
    figure = Figure(figsize=(WIDTH, WIDTH / len(planes)), layout="constrained")
    for axes, plane in zip(figure.subplots(1, len(planes), squeeze=False)[0], planes, strict=True):
        ends = np.quantile(means[:, plane], SHOWN, axis=0)
        ends = np.concatenate([ends, *(found[:, plane] for found in centers)])
        margin = 0.05 * np.ptp(ends, axis=0).max() + 1e-6
        low, high = ends.min(axis=0) - margin, ends.max(axis=0) + margin
        frame = np.stack([low, high], axis=1)
        look = {"norm": "log", "cmap": "Greys", "alpha": 0.8, "rasterized": True}
        axes.hist2d(*means[:, plane].T, BINS, range=frame, **look)
        for block in range(tree.num_blocks):
            cell = tree.cell(block)
            lower, upper = (np.clip(side.numpy()[[*plane]], low, high) for side in (cell.lower, cell.upper))
            axes.add_patch(Rectangle(lower, *(upper - lower), fill=False, edgecolor=STEPS))
            middle = (lower + upper) / 2
            axes.annotate(str(block + 1), middle, color=STEPS, ha="center", va="center", fontsize=13)
        for found, color in zip(centers, (QUIET, LAYERS), strict=False):
            axes.plot(*found[:, plane].T, ".", color=color, markersize=4)
        axes.set(aspect="equal", xlabel="xyz"[plane[0]], ylabel="xyz"[plane[1]], xlim=frame[0], ylim=frame[1])
    return _uri(figure)


def _over_time(axes: Axes, story: Story, what: str) -> Axes:
    """With time across, and dashed lines where a run was resumed."""
    axes.set(xlabel="training time (s)", ylabel=what, xlim=(0, max(story.end.seconds, 1e-3)))
    lay_grid(axes)
    for line in story.of(TrainingLine)[1:]:
        axes.axvline(line.seconds, color=QUIET, linewidth=0.8, linestyle="--")
    return axes


def _uri(figure: Figure) -> str:
    stream = BytesIO()
    figure.savefig(stream, format="svg", transparent=True, dpi=150, metadata={"Date": None})
    return data_uri(stream, "svg+xml")
