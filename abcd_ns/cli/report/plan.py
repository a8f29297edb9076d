"""The blocks of a scene in plan view: cells, how densely they are filled, and the cameras."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int64
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import FuncFormatter, MaxNLocator
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from abcd_ns.engine.space.tree import BlockTree
from abcd_ns.lab.results.style import in_style

WIDTH, EDGE, FOOT, LOWEST, LARGEST = 4.9, 0.5, 1.0, 1.2, 5.0
"""Inches: width of the figure, its scales beside and below, the drawing's height at least and at most."""
SHOWN = (0.03, 0.97)
"""Quantiles of the Gaussians between which the drawing reaches, and beyond where cameras are."""
MARGIN = 0.06
BINS = 160
COUNT_COLORS = "viridis"
INK, HELD_OUT, DARK, BRIGHT = "#444444", "#d55e00", "#010101", "#fefefe"
DISC, SIGHT = 0.055, 0.035
"""Of a block's number and of a camera's line of sight, as shares of the drawing."""


@dataclass(frozen=True)
class Plan:
    """A scene to be drawn, in world units; z is up."""

    tree: BlockTree
    means: Float[np.ndarray, "n 3"]
    owner: Int64[np.ndarray, "n"]
    """The block of each Gaussian."""
    cameras: Float[np.ndarray, "c 3"]
    directions: Float[np.ndarray, "c 3"]
    """Where the cameras look, of unit length."""
    held_out: Bool[np.ndarray, "c"]

    @property
    def is_stacked(self) -> bool:
        """Whether some cells lie above others."""
        return bool((self.tree.axis == 2).any())

    @cached_property
    def counts(self) -> Int64[np.ndarray, "b"]:
        """Gaussians by block."""
        return np.bincount(self.owner, minlength=self.tree.num_blocks)

    @cached_property
    def by_block(self) -> list[Float[np.ndarray, "m 3"]]:
        """The means of each block's Gaussians."""
        # Sorted once: to search all of them for each block would take as many passes as there are blocks.
        order = np.argsort(self.owner, kind="stable")
        return np.split(self.means[order], np.cumsum(self.counts)[:-1])


def make_plan(tree: BlockTree, means: Float[Tensor, "n 3"], cameras: Sequence[Cameras] = ()) -> Plan:
    """The scene of a checkpoint.

    Args:
        cameras: those trained on, and those held out; none where the data is gone.
    """
    sets = [found.camera_to_worlds.cpu().double().numpy() for found in cameras]
    poses = np.concatenate(sets) if sets else np.zeros((0, 3, 4))
    trained_on = len(sets[0]) if sets else 0
    return Plan(
        tree,
        means.double().numpy(),
        tree.assign(means).numpy(),
        poses[:, :, 3],
        -poses[:, :, 2],  # OpenGL's cameras look along -z
        np.arange(len(poses)) >= trained_on,
    )


@in_style
def draw_plan(plan: Plan, across: int = 0, along: int = 1) -> Figure:
    """The scene, of some Gaussians at least, as seen along the third axis.

    Args:
        across, along: the axes of the drawing, 0 to 2.
    """
    low, high = _bounds(plan, [across, along])
    extent = high - low
    height = min(max((WIDTH - EDGE) * extent[1] / extent[0], LOWEST), LARGEST)
    figure = Figure(figsize=(WIDTH, height + FOOT), layout="constrained")
    axes = figure.add_subplot()
    axes.set_aspect("equal")
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_xlabel("xyz"[across])
    axes.set_ylabel("xyz"[along])
    axes.xaxis.set_major_locator(MaxNLocator(6))
    axes.yaxis.set_major_locator(MaxNLocator(6))
    colors = ScalarMappable(Normalize(0, max(plan.counts.max(), 1)), COUNT_COLORS)
    sheet = _Sheet(axes, plan, [across, along], low, high, colors)
    sheet.draw_density()
    sheet.draw_cells()
    sheet.draw_cameras()
    sheet.draw_numbers()
    if plan.tree.num_blocks > 1:
        bar = figure.colorbar(colors, ax=axes, orientation="horizontal", shrink=0.6, aspect=40, pad=0.02)
        bar.set_label("Gaussians in the block")
        bar.outline.set_visible(False)
        bar.ax.xaxis.set_major_locator(MaxNLocator(4))
        bar.ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
    return figure


def push_apart(points: Sequence[Float[np.ndarray, "2"]], gap: float) -> Float[np.ndarray, "n 2"]:
    """Places near the given points, about `gap` apart where there is room."""
    places = np.array(points, dtype=float).reshape(-1, 2)
    # A little to one side each: equal points would have no direction to part in.
    numbers = np.arange(len(places))
    places += 1e-3 * gap * np.stack([numbers, -numbers], axis=1)
    for _ in range(100):
        away = places[:, None] - places[None]
        distance = np.linalg.norm(away, axis=2) + 2 * gap * np.eye(len(places))
        lack = np.maximum(gap - distance, 0) / 2
        if lack.max(initial=0) < 1e-3 * gap:
            break
        places += (away * (lack / np.maximum(distance, 1e-12))[..., None]).sum(axis=1)
    return places


def _bounds(plan: Plan, chosen: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner of what is shown."""
    low, high = np.quantile(plan.means[:, chosen], SHOWN, axis=0)
    if len(plan.cameras):
        low = np.minimum(low, plan.cameras[:, chosen].min(axis=0))
        high = np.maximum(high, plan.cameras[:, chosen].max(axis=0))
    margin = np.maximum(MARGIN * (high - low), 0.02 * (high - low).max() + 1e-6)
    return low - margin, high + margin


@dataclass(frozen=True)
class _Sheet:
    """A drawing under way."""

    axes: Axes
    plan: Plan
    chosen: list[int]
    """The axes of space that are shown."""
    low: Float[np.ndarray, "2"]
    high: Float[np.ndarray, "2"]
    colors: ScalarMappable

    @property
    def size(self) -> float:
        return float((self.high - self.low).max())

    def draw_density(self) -> None:
        """Where Gaussians are, in grey that deepens with the logarithm of their number."""
        extent, flat = self.high - self.low, self.plan.means[:, self.chosen]
        bins = [max(int(BINS * side / extent.max()), 8) for side in extent]
        borders = [(self.low[k], self.high[k]) for k in (0, 1)]
        counts, _, _ = np.histogram2d(*flat.T, bins=bins, range=borders)
        shade = np.log1p(counts.T) / max(np.log1p(counts.max()), 1e-9)
        # Grey with alpha, so that it shows on a light page and on a dark one.
        pixels = np.stack([*[np.full_like(shade, 0.45)] * 3, 0.85 * shade], axis=-1)
        place = (self.low[0], self.high[0], self.low[1], self.high[1])
        self.axes.imshow(pixels, extent=place, origin="lower", interpolation="nearest", zorder=1)

    def draw_cells(self) -> None:
        """All cells, cut off where the drawing ends; pale where some lie above others."""
        alpha = 0.28 if self.plan.is_stacked else 0.42
        for block, count in enumerate(self.plan.counts):
            lower, upper = self._cell(block)
            fill = self.colors.to_rgba(count, alpha=alpha)
            self.axes.add_patch(Rectangle(lower, *(upper - lower), facecolor=fill, linewidth=0, zorder=2))
            outline = {"fill": False, "edgecolor": INK, "linewidth": 0.8, "zorder": 3}
            self.axes.add_patch(Rectangle(lower, *(upper - lower), **outline))

    def draw_cameras(self) -> None:
        """A dot for each camera, and a line where it looks; held-out ones in another colour."""
        plan = self.plan
        for held_out, color in ((False, INK), (True, HELD_OUT)):
            rows = plan.held_out == held_out
            centers = plan.cameras[rows][:, self.chosen]
            tips = centers + SIGHT * self.size * plan.directions[rows][:, self.chosen]
            sights = LineCollection(np.stack([centers, tips], axis=1), colors=color, linewidths=0.7, zorder=4)
            self.axes.add_collection(sights, autolim=False)
            self.axes.plot(*centers.T, ".", color=color, markersize=3, zorder=5)

    def draw_numbers(self) -> None:
        """A disc with each block's number where its Gaussians are, in the colour of how many there are."""
        middles = [self._middle(block) for block in range(self.plan.tree.num_blocks)]
        disc = {"boxstyle": "circle,pad=0.25", "edgecolor": BRIGHT, "linewidth": 0.8}
        for block, place in enumerate(push_apart(middles, DISC * self.size)):
            fill = self.colors.to_rgba(self.plan.counts[block])
            is_bright = np.dot(fill[:3], (0.2126, 0.7152, 0.0722)) > 0.5
            self.axes.annotate(
                str(block + 1),
                place,
                ha="center",
                va="center",
                fontsize=7.5,
                color=DARK if is_bright else BRIGHT,
                bbox={**disc, "facecolor": fill},
                zorder=6,
            )

    def _cell(self, block: int) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner of what is shown of a cell."""
        cell = self.plan.tree.cell(block)
        corners = (side.numpy()[self.chosen] for side in (cell.lower, cell.upper))
        lower, upper = (np.clip(corner, self.low, self.high) for corner in corners)
        return lower, upper

    def _middle(self, block: int) -> np.ndarray:
        """Where a block's Gaussians are, or else its cell."""
        lower, upper = self._cell(block)
        own = self.plan.by_block[block][:, self.chosen]
        return np.clip(np.median(own, axis=0), lower, upper) if len(own) else (lower + upper) / 2
