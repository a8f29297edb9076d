"""How charts look: colours, marks and type, the same in all of them."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import wraps
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Annotation
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

P, R = ParamSpec("P"), TypeVar("R")

LOOKS = {
    "abcd-monolithic": ("#D55E00", "s"),
    "abcd": ("#0072B2", "o"),
    "abcd-ablated": ("#8A5A83", "^"),
    "abcd-partition": ("#8A6A00", "v"),
    "abcd-exact": ("#B3306B", "X"),
    "abcd-paper": ("#7A3E00", "P"),
    "splatfacto": ("#007A5A", "D"),
}
"""Colours after Okabe and Ito 2008, told apart with every kind of colour blindness, darkened where text needs
it; and markers, for print without colour."""
COLORS = {method: color for method, (color, _) in LOOKS.items()}
MARKERS = {method: marker for method, (_, marker) in LOOKS.items()}
STYLE = {
    "font.family": "sans-serif",
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "text.parse_math": False,  # names are anyone's: two $ in one are no formula
    "svg.fonttype": "none",  # in a report's page text stays text
    "svg.hashsalt": "abcd",  # the same chart gives the same bytes
}
DPI = 300
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


def save(figure: Figure, out: Path, name: str) -> Path:
    """Write the chart as name.png; returns its path."""
    path = out / f"{name}.png"
    figure.savefig(path, dpi=DPI)
    return path


def in_style(draw: Callable[P, R]) -> Callable[P, R]:
    """A function that draws in the style of all charts."""

    @wraps(draw)
    def styled(*args: P.args, **kwargs: P.kwargs) -> R:
        with matplotlib.rc_context(STYLE):
            return draw(*args, **kwargs)

    return styled


def lay_grid(axes: Axes) -> None:
    """Pale lines behind everything."""
    axes.grid(color="#d9d9d9", linewidth=0.5)
    axes.set_axisbelow(True)


def plot(axes: Axes, x: Sequence[float], y: Sequence[float], method: str, **more: Any) -> Line2D:
    """A method's line with its marks, in its colour; `more` goes before the usual look."""
    look = {"markersize": 5, "markeredgecolor": "white", "markeredgewidth": 0.5, "linewidth": 1.4}
    (line,) = axes.plot(x, y, **{**look, "color": COLORS[method], "marker": MARKERS[method], **more})
    return line


def write_beside(
    axes: Axes, text: str, xy: tuple[float, float], offset: tuple[float, float], **more: Any
) -> Annotation:
    """A word beside a point, `offset` printer's points away; `more` is matplotlib's."""
    return axes.annotate(text, xy=xy, xytext=offset, textcoords="offset points", **{"fontsize": 8, **more})


def tick_at(axes: Axes, values: Iterable[float], write: Callable[[float], str], base: int | None = 2) -> None:
    """Marks on the axis of x at these values and no others, on a logarithmic scale if there is a base."""
    if base is not None:
        axes.set_xscale("log", base=base)
    axes.xaxis.set_major_locator(FixedLocator(sorted(set(values))))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: write(value)))


def short(count: float) -> str:
    """32000 as 32k."""
    if count >= 1e6:
        return f"{count / 1e6:.3g}M"
    return f"{count / 1e3:.3g}k" if count >= 1000 else f"{count:g}"


def label_ends(
    axes: Axes,
    ends: dict[str, tuple[float, float]],
    right: float,
    colors: Mapping[str, str] = COLORS,
    write: Callable[[str, float], str] = "{}  {:.2f}".format,
    gap: float = LABEL_GAP,
) -> None:
    """Each curve's name and last value beside its end, in its colour.

    Args:
        ends: (x, y) by name; on charts of PSNR the method's.
        right: where the labels begin, on the axis of x.
        colors: by name.
        write: the label, from name and y.
        gap: least distance of two labels, as a share of the axis' height.
    """
    low, high = axes.get_ylim()
    heights = spread([y for _, y in ends.values()], gap * (high - low))
    # Above the axis they would run into the title, below it into its numbers.
    from_top = sorted(range(len(heights)), key=heights.__getitem__, reverse=True)
    for k, i in enumerate(from_top):
        heights[i] = min(heights[i], high - k * gap * (high - low))
    lift = max(low + gap * (high - low) / 2 - min(heights), 0)
    for (name, (x, y)), height in zip(ends.items(), heights, strict=True):
        axes.annotate(
            write(name, y),
            xy=(x, y),
            xytext=(right, height + lift),
            color=colors[name],
            va="center",
            annotation_clip=False,
            arrowprops={
                "arrowstyle": "-",
                "color": colors[name],
                "linewidth": 0.5,
                "shrinkB": 3,
                "relpos": (0, 0.5),
            },
        )
