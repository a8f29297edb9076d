"""What is drawn in one pass, where each view drawn alone would cost more in calls than in work."""

from collections.abc import Iterator, Sequence
from typing import TypeVar

from abcd_ns.engine.types import Crop

Item = TypeVar("Item")
DEVICE_PIXELS, DEVICE_SPLATS = 1 << 21, 400_000
"""Of the views that an accelerator draws together, at most, unless a single view has more."""


def runs(
    items: Sequence[Item],
    crops: Sequence[Crop],
    pixels: int,
    *,
    gaussians: int = 0,
    splats: int = 0,
    padded: bool = False,
) -> Iterator[list[Item]]:
    """The items, a crop each, in runs of neighbours.

    Args:
        pixels: most of a run of more than one.
        gaussians: that are drawn in each crop, if they are limited, too.
        splats: most of these in all crops of a run of more than one.
        padded: each crop is drawn as large as the largest of its run.
    """
    run: list[Item] = []
    taken: list[Crop] = []
    for item, crop in zip(items, crops, strict=True):
        taken.append(crop)
        drawn = sum(each.pixels for each in taken)
        if padded:
            drawn = len(taken) * max(each.width for each in taken) * max(each.height for each in taken)
        if run and (drawn > pixels or (len(run) + 1) * gaussians > splats):
            yield run
            run, taken = [], [crop]
        run.append(item)
    if run:
        yield run
