"""A curve as a small picture in the panel: an SVG of a few KiB.

viser can show plotly's figures, but sends every browser 5 MiB of script for it, and its version 0.2 may draw
them wider than the panel.
"""

import base64
import math
from collections.abc import Sequence

WIDTH, HEIGHT = 260, 130
LEFT, RIGHT, TOP, BOTTOM = 30, 6, 6, 18
"""Margins, px; ticks are written in them."""
LINE, GRID, TEXT = "#ffd369", "#3a3f4b", "#c1c2c5"
TICKS = 4
"""About so many on an axis."""


def curve_image(points: Sequence[tuple[float, float]], name: str) -> str:
    """The curve through these points as a Markdown image; without at least two, a sentence.

    Args:
        name: what the picture shows, for whoever cannot see it.
    """
    if len(points) < 2:
        return "Nothing to show yet."
    svg = base64.b64encode(curve_svg(points).encode()).decode()
    return f"![{name}](data:image/svg+xml;base64,{svg})"


def curve_svg(points: Sequence[tuple[float, float]]) -> str:
    """The curve through (x, y) points, two or more, with round numbers on its axes."""
    xs, ys = zip(*points, strict=True)
    across = _Axis(min(xs), max(xs), LEFT, WIDTH - RIGHT)
    up = _Axis(min(ys), max(ys), HEIGHT - BOTTOM, TOP)
    rows = "".join(f"M{LEFT} {up(tick):.1f}H{WIDTH - RIGHT}" for tick in up.ticks)
    columns = "".join(f"M{across(tick):.1f} {TOP}V{HEIGHT - BOTTOM}" for tick in across.ticks)
    labels = [
        *(_label(f"{tick:g}", LEFT - 4, up(tick) + 3, "end") for tick in up.ticks),
        *(_label(f"{tick:g}", across(tick), HEIGHT - 5, "middle") for tick in across.ticks),
    ]
    line = " ".join(f"{across(x):.1f},{up(y):.1f}" for x, y in points)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH}" height="{HEIGHT}" '
        f'font-family="sans-serif" font-size="9" fill="none">'
        f'<path d="{rows}{columns}" stroke="{GRID}"/>{"".join(labels)}'
        f'<polyline points="{line}" stroke="{LINE}" stroke-width="1.5"/></svg>'
    )


class _Axis:
    """Maps a range of values to pixels."""

    def __init__(self, low: float, high: float, start: float, stop: float) -> None:
        high = high if high > low else low + 1.0
        self._low, self._start, self._scale = low, start, (stop - start) / (high - low)
        step = _round_step((high - low) / TICKS)
        self.ticks = [step * k for k in range(math.ceil(low / step), math.floor(high / step) + 1)]
        """Round values within the range."""

    def __call__(self, value: float) -> float:
        return self._start + (value - self._low) * self._scale


def _round_step(step: float) -> float:
    """The smallest of 1, 2, 5 x 10^k that is at least `step`."""
    power = 10.0 ** math.floor(math.log10(step))
    return next(power * lead for lead in (1, 2, 5, 10) if power * lead >= step * (1 - 1e-9))


def _label(text: str, x: float, y: float, anchor: str) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" fill="{TEXT}">{text}</text>'
