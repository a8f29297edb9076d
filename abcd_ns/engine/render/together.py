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
    padded: bool = False,
) -> Iterator[list[Item]]:
    """The items, a crop each, in runs of neighbours of one kind.

    Args:
        pixels: most of a run of more than one.
        gaussians: that are drawn in each crop, if they are limited, too.
        splats: most of these in all crops of a run of more than one.
        kinds: of each item; None if they are all alike.
        padded: each crop is drawn as large as the largest of its run.
    """
    run: list[Item] = []
    taken: list[Crop] = []
    kind = None
    for item, crop, own in zip(items, crops, kinds or [None] * len(items), strict=True):
        taken.append(crop)
        drawn = _padded(taken) if padded else sum(each.pixels for each in taken)
        if run and (own != kind or drawn > pixels or (len(run) + 1) * gaussians > splats):
            yield run
            run, taken = [], [crop]
        kind = own
        run.append(item)
    if run:
        yield run


def _padded(crops: Sequence[Crop]) -> int:
    """Pixels of so many crops, as wide and as high as any of them."""
    return len(crops) * max(crop.width for crop in crops) * max(crop.height for crop in crops)
