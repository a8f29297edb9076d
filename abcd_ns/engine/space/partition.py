"""How space is cut into blocks: a k-d tree balanced by count, or a regular grid."""

import math
from itertools import count

from jaxtyping import Float, Float64
from torch import Tensor

from abcd_ns.engine.space.tree import EVERYWHERE, BlockTree, Box

MAX_BLOCKS = 65_536
"""The most blocks that space may be cut into to begin with, and the most cells of a grid: far more than any
scene needs, few enough to fit in memory."""


def best_split(points: Float[Tensor, "n 3"], box: Box, share: float = 0.5) -> tuple[int, float]:
    """Where to cut `box` so that `share` of its points fall to the left.

    Takes the axis along which the points reach furthest, outliers aside, unless equal coordinates make that
    cut miss its share by over a tenth of the points and another axis does better. An empty cell is cut off
    where all points coincide, or there are none.

    Args:
        points: inside `box`, finite.
        share: 0 to 1.

    Returns:
        (axis, threshold), for BlockTree.split. The threshold lies strictly inside the box, and strictly
        between two points' coordinates where float64 has room there.
    """
    points, total = points.detach().cpu(), len(points)
    best: tuple[float, int, float] | None = None
    for axis in _axes_by_extent(points):
        cut = _cut_along(points[:, axis].double(), share * total)
        if cut is not None and (best is None or cut[0] < best[0]):
            best = (cut[0], axis, cut[1])
        if best is not None and best[0] <= 0.1 * total:
            break
    if best is not None:
        return best[1], best[2]
    return _cut_off(box, points[0].tolist() if len(points) else [0.0] * 3)


def build_kd(points: Float[Tensor, "n 3"], num_blocks: int) -> BlockTree:
    """A tree of `num_blocks` cells with equal numbers of points; deterministic.

    Counts differ by at most one where all coordinates are distinct. Points that coincide stay together,
    so with few distinct points some blocks start empty, but there are always `num_blocks`.

    Raises:
        ValueError: `num_blocks` < 1, or a point that is not finite.
    """
    if num_blocks < 1:
        raise ValueError(f"cannot build {num_blocks} blocks: ask for 1 or more")
    _check_finite(points)
    return _flatten(_kd_node(points.detach().cpu(), EVERYWHERE, num_blocks))


def build_grid(points: Float[Tensor, "n 3"], counts: tuple[int, int, int]) -> BlockTree:
    """A regular grid of so many cells on each axis, as nested splits, over where the points are (outliers
    aside). The outermost cells reach to infinity.

    Raises:
        ValueError: `counts` are not positive, over MAX_BLOCKS in all, or a point is not finite.
    """
    if min(counts) < 1 or math.prod(counts) > MAX_BLOCKS:
        raise ValueError(f"a grid has at least one cell on each axis and {MAX_BLOCKS} in all, not {counts}")
    _check_finite(points)
    start, stop = robust_range(points.detach().cpu())
    # Without any extent every cell size is as good as another; 1 keeps the planes apart.
    sizes = [(extent or 1.0) / n for extent, n in zip((stop - start).tolist(), counts, strict=True)]
    grid = zip(start.tolist(), sizes, counts, strict=True)
    return _flatten(_grid_node([[lo + size * i for i in range(1, n)] for lo, size, n in grid]))


def _kd_node(points: Tensor, box: Box, k: int) -> tuple | None:
    """The subtree of `k` cells over these points, as nested (axis, threshold, left, right); None is a leaf.

    Rounding does not add up on the way down: of q k + r points with r < k, the left half of the cells gets
    q (k // 2) and r's share, rounded. So q stays the same in all subtrees, and leaves get q or q + 1.
    """
    if k == 1:
        return None
    axis, threshold = best_split(points, box, (k // 2) / k)
    below = points[:, axis].double() < threshold
    lower, upper = box.lower.clone(), box.upper.clone()
    upper[axis] = lower[axis] = threshold
    left = _kd_node(points[below], Box(box.lower, upper), k // 2)
    right = _kd_node(points[~below], Box(lower, box.upper), k - k // 2)
    return axis, threshold, left, right


def _grid_node(planes: list[list[float]]) -> tuple | None:
    """The subtree over the cells between sorted `planes` of each axis, nested as in _kd_node."""
    axis = max(range(3), key=lambda a: len(planes[a]))
    if not planes[axis]:
        return None
    middle = len(planes[axis]) // 2
    below = [p[:middle] if a == axis else p for a, p in enumerate(planes)]
    above = [p[middle + 1 :] if a == axis else p for a, p in enumerate(planes)]
    return axis, planes[axis][middle], _grid_node(below), _grid_node(above)


def robust_range(points: Float[Tensor, "n 3"]) -> tuple[Float64[Tensor, "3"], Float64[Tensor, "3"]]:
    """The 5th and 95th percentile on each axis; zeros without points."""
    points = points if len(points) else points.new_zeros((1, 3))
    tail = int(0.05 * (len(points) - 1))
    ends = (points.kthvalue(k, dim=0).values.double() for k in (tail + 1, len(points) - tail))
    return tuple(ends)


def _axes_by_extent(points: Float[Tensor, "n 3"]) -> list[int]:
    """Axes from the widest to the narrowest; by the full range where the bulk of the points coincides."""
    start, stop = robust_range(points)
    robust = (stop - start).tolist()
    full = (points.amax(dim=0).double() - points.amin(dim=0)).tolist() if len(points) else robust
    return sorted(range(3), key=lambda axis: (-robust[axis], -full[axis]))


def _cut_along(values: Float64[Tensor, "n"], target: float) -> tuple[float, float] | None:
    """(miss, threshold) of the cut with about `target` values below it; None if all values are equal."""
    values = values.sort().values
    gaps = (values[:-1] < values[1:]).nonzero()[:, 0]
    if not len(gaps):
        return None
    misses = (gaps + 1 - target).abs()
    best = int(misses.argmin())
    low, high = values[gaps[best] : gaps[best] + 2].tolist()
    middle = low / 2 + high / 2  # Not (low + high) / 2, which may overflow.
    return float(misses[best]), middle if low < middle < high else high


def _cut_off(box: Box, point: list[float]) -> tuple[int, float]:
    """(axis, threshold) of some plane through `box`, near `point` where the box gives no other hint."""
    lower, upper = box.lower.tolist(), box.upper.tolist()
    axis = max(range(3), key=lambda a: (math.isinf(lower[a]) + math.isinf(upper[a]), upper[a] - lower[a]))
    lo, hi = lower[axis], upper[axis]
    if math.isinf(lo):
        return axis, point[axis] if math.isinf(hi) else hi - max(1.0, abs(hi))
    return axis, lo + max(1.0, abs(lo)) if math.isinf(hi) else lo / 2 + hi / 2


def _flatten(nested: tuple | None) -> BlockTree:
    """The tree of nested (axis, threshold, left, right), blocks numbered from left to right."""
    rows: list[tuple] = []
    blocks = count()

    def add(part: tuple | None) -> int:
        node = len(rows)
        rows.append((-1, 0.0, -1, -1, next(blocks)) if part is None else ())
        if part is not None:
            rows[node] = (part[0], part[1], add(part[2]), add(part[3]), -1)
        return node

    add(nested)
    return BlockTree(tuple(rows))


def _check_finite(points: Tensor) -> None:
    bad = int((~points.isfinite()).any(dim=1).sum())
    if bad:
        raise ValueError(f"{bad} of {len(points)} points are NaN or infinite: drop them first")
