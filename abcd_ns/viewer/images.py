"""Small images in the panel, as Markdown; viser's own plots send every browser 5 MiB of script."""

import base64
import io
from collections.abc import Sequence

import numpy as np
from jaxtyping import UInt8
from PIL import Image

WIDTH = 260  # of the panel, px
MOST_POINTS = 400  # of a curve; of more, an evenly spaced choice is drawn
LINE, GRID, TEXT = "#ffd369", "#3a3f4b", "#c1c2c5"


def curve_image(points: Sequence[tuple[float, float]], name: str) -> str:
    """The curve through (x, y) points, with an alternative text; a sentence for fewer than two points."""
    if len(points) < 2:
        return "Nothing to show yet."
    import matplotlib  # runs do without it
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH / 96, WIDTH / 192), layout="constrained")  # at 96 px an inch
    axes = figure.add_subplot(facecolor="none")
    shown = points[:: -(-len(points) // MOST_POINTS)]
    axes.plot(*zip(*shown, strict=True), color=LINE, linewidth=1)
    axes.tick_params(labelsize=6, labelcolor=TEXT, color=GRID)
    axes.grid(color=GRID)
    axes.spines[:].set_visible(False)
    with matplotlib.rc_context({"svg.fonttype": "none"}):  # text stays text: a few KiB
        figure.savefig(svg := io.BytesIO(), format="svg", transparent=True)
    return f"![{name}]({data_uri(svg, 'svg+xml')})"


def photo_image(photo: UInt8[np.ndarray, "h w c"], name: str) -> str:
    """A photo, as wide as the panel."""
    image = Image.fromarray(photo[..., :3])
    image.thumbnail((2 * WIDTH, 2 * WIDTH))  # sharp on screens of high resolution
    image.save(jpeg := io.BytesIO(), format="JPEG")
    return f"![{name}]({data_uri(jpeg, 'jpeg')})"


def data_uri(file: io.BytesIO, kind: str) -> str:
    """An image that stands in a page itself."""
    return f"data:image/{kind};base64,{base64.b64encode(file.getvalue()).decode()}"
