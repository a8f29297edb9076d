"""How charts look: colours, marks and type, the same in all of them."""

from pathlib import Path

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure

LOOKS = {
    "abcd-monolithic": ("#D55E00", "s"),
    "abcd": ("#0072B2", "o"),
    "abcd-ablated": ("#8A5A83", "^"),
    "abcd-partition": ("#8A6A00", "v"),
    "abcd-exact": ("#B3306B", "X"),
    "abcd-paper": ("#7A3E00", "P"),
    "splatfacto": ("#007A5A", "D"),
    "splatfacto-scaled": ("#5B9B3A", "d"),
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
    "legend.frameon": False,
    "lines.linewidth": 1.4,
    "lines.markeredgecolor": "white",
    "lines.markersize": 5,
    "text.parse_math": False,  # names are anyone's: two $ in one are no formula
    "svg.fonttype": "none",  # in a report's page text stays text
    "svg.hashsalt": "abcd",  # the same chart gives the same bytes
}
DPI = 300


def save(figure: Figure, out: Path, name: str) -> Path:
    """Write the chart as name.png; returns its path."""
    path = out / f"{name}.png"
    figure.savefig(path, dpi=DPI)
    return path


in_style = matplotlib.rc_context(STYLE)  # decorates a function that draws in the style of all charts


def lay_grid(axes: Axes) -> None:
    """Pale lines behind everything."""
    axes.grid(color="#d9d9d9", linewidth=0.5)
    axes.set_axisbelow(True)
