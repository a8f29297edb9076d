"""What is drawn in one pass, where each view drawn alone would cost more in calls than in work."""

from collections.abc import Hashable, Iterator, Sequence
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
    kinds: Sequence[Hashable] | None = None,
) -> Iterator[list[Item]]:
    """The items, a crop each, in runs of neighbours of one kind.

    Args:
        pixels: most of a run of more than one.
        gaussians: that are drawn in each crop, if they are limited, too.
        splats: most of these in all crops of a run of more than one.
        kinds: of each item; None if they are all alike.
    """
    run: list[Item] = []
    drawn, kind = 0, None
    for item, crop, own in zip(items, crops, kinds or [None] * len(items), strict=True):
        drawn += crop.pixels
        if run and (own != kind or drawn > pixels or (len(run) + 1) * gaussians > splats):
            yield run
            run, drawn = [], crop.pixels
        kind = own
        run.append(item)
    if run:
        yield run
