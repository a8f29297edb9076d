"""Random parts of a crop, for steps that cannot hold all of it."""

import random

from abcd_ns.engine.types import Crop

ALIGN = 16
"""Parts meet at multiples of this in the image, pixels: gsplat's tiles are whole then."""
PLAY = 64
"""The room in which the lines between parts move from step to step, where parts are larger, pixels. SSIM's
windows of 11 px are left out where a line crosses them: by columns, and by rows, one time in five at most."""


def random_part(crop: Crop, most: int, rng: random.Random) -> Crop:
    """One of the rectangles that a random grid cuts the crop into, as likely as it is large.

    The grid has as few columns and rows of equal cells as keep these within `most` pixels and nearly square.
    Where a picture's loss is a sum over pixels, L = sum of l, the sum over a part, times crop.pixels /
    part.pixels, has the expectation L whatever the grid: a part P is drawn with probability
    P.pixels / crop.pixels, and the parts of a grid are all of the crop.

    Args:
        most: pixels of the part; 0 for no limit. A part may have ALIGN x ALIGN in any case.
        rng: gives the grid and the part; left alone where the crop is small enough.
    """
    if most <= 0 or crop.pixels <= most:
        return crop
    columns, rows = _counts(crop, most)
    x, width = _random_span(crop.x, crop.width, columns, rng)
    y, height = _random_span(crop.y, crop.height, rows, rng)
    return Crop(x, y, width, height)


def _counts(crop: Crop, most: int) -> tuple[int, int]:
    """Columns and rows of the grid."""
    columns = rows = 1
    while True:
        width, height = _side(crop.x, crop.width, columns), _side(crop.y, crop.height, rows)
        if width * height <= most or max(width, height) <= ALIGN:
            return columns, rows
        if width >= height:
            columns += 1
        else:
            rows += 1


def _side(start: int, size: int, count: int) -> int:
    """Pixels of each of `count` cells along one axis; the grid sticks out of the crop by PLAY or more."""
    if count == 1:
        return size
    covered = size + start % ALIGN
    play = min(PLAY, covered // count // ALIGN * ALIGN)
    return ALIGN * max(1, -(-(covered + play) // (count * ALIGN)))


def _random_span(start: int, size: int, count: int, rng: random.Random) -> tuple[int, int]:
    """(first pixel, number of pixels) of the cell that a random pixel lies in."""
    if count == 1:
        return start, size
    side, origin = _side(start, size, count), start - start % ALIGN
    slack = count * side - (start + size - origin)
    origin -= ALIGN * rng.randrange(slack // ALIGN + 1)
    first = origin + (start + rng.randrange(size) - origin) // side * side
    low, high = max(first, start), min(first + side, start + size)
    return low, high - low
