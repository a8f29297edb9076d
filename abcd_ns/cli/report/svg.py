"""matplotlib's figures as SVG that stands in a page: its colours follow the page's theme."""

import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from io import StringIO

import matplotlib
from matplotlib.figure import Figure

from abcd_ns.lab.results.style import STYLE

DARK = {
    "#000000": "#e4e7eb",
    "#444444": "#c3c8cf",
    "#767676": "#9aa1ab",
    "#d9d9d9": "#343a43",
    "#ffffff": "#171a1f",
    "#d55e00": "#ff9a4d",
    "#0072b2": "#5ab8f0",
    "#8a5a83": "#cf9fc8",
    "#8a6a00": "#d8b64a",
    "#b3306b": "#f083b0",
    "#7a3e00": "#d79a63",
    "#007a5a": "#3fc79e",
}
"""What the charts' colours turn into on a dark page."""
_SVG, _XLINK = "{http://www.w3.org/2000/svg}", "{http://www.w3.org/1999/xlink}"
_METADATA = dict.fromkeys(("Date", "Creator", "Format", "Type"))
_REFERENCE = re.compile(r"(url\(#|^#)([^)]+)")
"""An attribute's way to name an element by its id."""


def inline_svg(figure: Figure, name: str, label: str, titles: Mapping[str, str]) -> str:
    """The figure as an <svg> element.

    Args:
        name: made of letters and hyphens; sets its ids apart from those of other figures of the page.
        label: what it shows, for who cannot see it.
        titles: by gid of an artist, what a pointer on it is told.
    """
    stream = StringIO()
    with matplotlib.rc_context(STYLE):
        figure.savefig(stream, format="svg", transparent=True, metadata=_METADATA)
    root = ET.fromstring(stream.getvalue())
    for part in ("width", "height"):
        del root.attrib[part]
    root.attrib |= {"role": "img", "aria-label": label}
    for style in [found for found in root.iter(f"{_SVG}defs") if found.find(f"{_SVG}style") is not None]:
        # It would hold for the whole page; page.css has it for charts.
        style.clear()
    values = [value for element in root.iter() for value in element.attrib.values()]
    used = {own for value in values for _, own in _REFERENCE.findall(value)}
    for element in list(root.iter()):
        if (text := titles.get(element.get("id", ""))) is not None:
            element.insert(0, title := ET.Element("title"))
            title.text = text
        element.tag = element.tag.removeprefix(_SVG)
        element.attrib = {
            key.removeprefix(_XLINK): f"{name}-{value}" if key == "id" else _of_page(value, name)
            for key, value in element.attrib.items()
            if key != "id" or value in used
        }
    return ET.tostring(root, encoding="unicode")


def theme_css() -> str:
    """The colours of a dark page, as CSS variables."""
    return " ".join(f"{_variable(light)}: {dark};" for light, dark in DARK.items())


def _of_page(value: str, name: str) -> str:
    """An attribute in which ids are the figure's own, and colours those of the page's theme."""

    def follow(match: re.Match[str]) -> str:
        color = match.group().lower()
        return f"var({_variable(color)}, {color})" if color in DARK else color

    return re.sub(r"#[0-9a-fA-F]{6}\b", follow, _REFERENCE.sub(rf"\1{name}-\2", value))


def _variable(color: str) -> str:
    return f"--c-{color[1:]}"
