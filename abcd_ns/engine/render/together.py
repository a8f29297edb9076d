"""Which views are drawn in one pass, where each drawn alone would cost more in calls than in work."""

from collections.abc import Iterator, Sequence
from typing import TypeVar

from abcd_ns.engine.types import Crop, View

Item = TypeVar("Item")
DEVICE_PIXELS, DEVICE_SPLATS = 1 << 21, 400_000
"""Of the views that an accelerator draws together, at most, unless a single view has more."""


def runs(
    items: Sequence[Item], seen: Sequence[tuple[View, Crop]], gaussians: int, *, pixels: int, splats: int
) -> Iterator[list[Item]]:
    """The items, each what a view sees, in runs of neighbours whose images are of one size and near plane.

    Args:
        gaussians: that each of them draws.
        pixels, splats: most of a run of more than one.
    """
    run: list[Item] = []
    drawn, kind = 0, None
    for item, (view, crop) in zip(items, seen, strict=True):
        drawn += crop.pixels
        alike = kind == (view.width, view.height, view.near)
        if run and (not alike or drawn > pixels or (len(run) + 1) * gaussians > splats):
            yield run
            run, drawn = [], crop.pixels
        kind = (view.width, view.height, view.near)
        run.append(item)
    if run:
        yield run
