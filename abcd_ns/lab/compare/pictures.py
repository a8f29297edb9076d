"""Held-out views side by side: photo, every method's picture, and below each its error."""

import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from numpy.typing import NDArray
from PIL import Image

from abcd_ns.engine.render.loss import decibels
from abcd_ns.lab.results.results import Run
from abcd_ns.lab.results.style import in_style

ERROR_GAIN = 4
"""By how much errors are amplified; 1 / ERROR_GAIN is the largest that can be told from larger ones."""
ERROR_COLORS = "inferno"
COLUMN_INCHES = 2.6
PictureArray = NDArray[np.uint8]


def error_map(picture: PictureArray, photo: PictureArray) -> NDArray[np.float32]:
    """|picture - photo|, mean over the colour channels: [h, w] in 0..1."""
    return np.abs(picture.astype(np.float32) - photo.astype(np.float32)).mean(axis=2) / 255


@in_style
def draw_comparison(photo: PictureArray, pictures: dict[str, PictureArray], title: str, path: Path) -> None:
    """Write one figure: photo and pictures, by the name to print above each, and errors below, on one scale
    with its legend."""
    height, width = photo.shape[:2]
    columns = 1 + len(pictures)
    size = (COLUMN_INCHES * columns, 2 * (COLUMN_INCHES * height / width + 0.25) + 0.25)
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(2, columns)
    figure.suptitle(title, fontsize=9)
    _show(grid[0, 0], photo, "photo")
    for column, (name, picture) in enumerate(pictures.items(), start=1):
        psnr = decibels(np.mean((picture.astype(np.float64) - photo) ** 2) / 255**2)
        _show(grid[0, column], picture, f"{name}  {psnr:.2f} dB")
        map_of_errors = error_map(picture, photo)
        below = f"mean error {map_of_errors.mean():.1%}"
        error = _show(grid[1, column], map_of_errors, below, cmap=ERROR_COLORS, vmin=0, vmax=1 / ERROR_GAIN)
    grid[1, 0].axis("off")
    inset = grid[1, 0].inset_axes((0.08, 0.52, 0.84, 0.09))
    label = f"|picture - photo| x {ERROR_GAIN}\n(mean of R, G, B; share of full scale)"
    bar = figure.colorbar(error, cax=inset, orientation="horizontal", extend="max", label=label)
    bar.ax.xaxis.set_major_formatter(lambda share, _: f"{share:.0%}")
    # No less than a dot per pixel, so that nothing that is shown is lost.
    figure.savefig(path, dpi=min(max(200.0, 1.1 * width / COLUMN_INCHES), 400.0))


def _show(axes: Axes, picture: NDArray, title: str, **look: object) -> AxesImage:
    axes.set(title=title, xticks=[], yticks=[])
    axes.spines[:].set_visible(False)
    return axes.imshow(picture, interpolation="nearest", **look)


def draw_pictures(runs: Sequence[tuple[str, Run, Path]], out: Path) -> list[Path]:
    """One figure for each held-out view that the runs left pictures of in their folders; returns the paths.
    Each run has a label before it."""
    if not runs:
        return []
    _, first, folder = runs[0]
    shutil.rmtree(out, ignore_errors=True)  # of an earlier comparison, with other views
    out.mkdir()
    paths = []
    seeds = ", ".join(map(str, sorted({run.seed for _, run, _ in runs})))
    for found in sorted(folder.glob("photo-*.png")):
        row = int(found.stem.removeprefix("photo-"))
        pictures = {label: _read(path / f"merged-{row:04d}.png") for label, _, path in runs}
        name = next(view.name for view in first.views if view.row == row)
        paths.append(out / f"view-{row:04d}.png")
        title = f"{first.scene}, held-out view {name}, merged, seed {seeds}"
        draw_comparison(_read(found), pictures, title, paths[-1])
    return paths


def _read(path: Path) -> PictureArray:
    with Image.open(path) as image:
        return np.asarray(image)
