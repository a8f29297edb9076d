"""How charts look: colours, marks and type, the same in all of them."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

COLORS = {
    "abcd-monolithic": "#D55E00",
    "abcd": "#0072B2",
    "abcd-ablated": "#8A5A83",
    "abcd-partition": "#8A6A00",
    "abcd-exact": "#B3306B",
    "abcd-paper": "#7A3E00",
    "splatfacto": "#007A5A",
}
"""After Okabe and Ito 2008, told apart with every kind of colour blindness; darkened where text needs it."""
MARKERS = {
    "abcd-monolithic": "s",
    "abcd": "o",
    "abcd-ablated": "^",
    "abcd-partition": "v",
    "abcd-exact": "X",
    "abcd-paper": "P",
    "splatfacto": "D",
}
"""For print without colour."""
STYLE = {
    "font.family": "sans-serif",
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "svg.fonttype": "none",  # text stays text: searchable, and set in the paper's font
    "svg.hashsalt": "abcd",  # the same chart gives the same bytes
}
FORMATS = ("png", "svg")
LABEL_GAP = 0.06
"""Least distance of two labels, as a share of the axis' height."""


def spread(wanted: Sequence[float], gap: float) -> list[float]:
    """Positions near the `wanted` ones, in their order of height, at least `gap` apart."""
    order = np.argsort(wanted, kind="stable")
    placed = np.asarray(wanted, dtype=float)[order]
    for _ in range(100):
        moved = False
        for i in range(len(placed) - 1):
            lack = gap - (placed[i + 1] - placed[i])
            if lack > 1e-9:
                placed[i] -= lack / 2
                placed[i + 1] += lack / 2
                moved = True
        if not moved:
            break
    result = np.empty_like(placed)
    result[order] = placed
    return result.tolist()


def save(figure: Figure, out: Path, name: str) -> list[Path]:
    """Write the chart as name.png and name.svg; returns their paths."""
    paths = [out / f"{name}.{ending}" for ending in FORMATS]
    for path in paths:
        figure.savefig(path, dpi=300, metadata={"Date": None} if path.suffix == ".svg" else None)
    return paths


def lay_grid(axes: Axes) -> None:
    """Pale lines behind everything."""
    axes.grid(color="#d9d9d9", linewidth=0.5)
    axes.set_axisbelow(True)


def label_ends(axes: Axes, ends: dict[str, tuple[float, float]], right: float) -> None:
    """Each method's name and last value beside the end of its curve, in its colour.

    Args:
        ends: (x, PSNR) by method.
        right: where the labels begin, on the axis of x.
    """
    low, high = axes.get_ylim()
    heights = spread([psnr for _, psnr in ends.values()], LABEL_GAP * (high - low))
    for (method, (x, psnr)), height in zip(ends.items(), heights, strict=True):
        axes.annotate(
            f"{method}  {psnr:.2f}",
            xy=(x, psnr),
            xytext=(right, height),
            color=COLORS[method],
            va="center",
            annotation_clip=False,
            arrowprops={
                "arrowstyle": "-",
                "color": COLORS[method],
                "linewidth": 0.5,
                "shrinkB": 3,
                "relpos": (0, 0.5),
            },
        )
