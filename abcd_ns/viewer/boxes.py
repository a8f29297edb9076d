"""Blocks as boxes. The outermost cells are infinite, so boxes are cut to the bulk of the points."""

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.space.tree import BlockTree, Box

SCENE_SCALE = 10.0
"""Units of nerfstudio's viewer in a world unit."""
BULK = 0.95
"""Share of the points, on each axis, that the outermost boxes reach to."""
MARGIN = 0.05
"""By how much they reach farther, as a share of that extent."""
GAP = 0.004
"""Between the boxes of neighbours, as a share of the bulk's diagonal: faces that coincide would flicker."""
MOST_POINTS = 100_000
"""Of which the bulk is found."""

_PATH = (0, 4, 6, 2, 0, 1, 5, 4, 5, 7, 6, 7, 3, 2, 3, 1)
"""Corners in an order that follows all edges of a box; their bits say which are upper, x first."""


def bulk(means: Float[Tensor, "n 3"]) -> Box:
    """The box that holds nearly all points; outliers do not stretch it. A unit cube if there are none."""
    points = means[torch.isfinite(means).all(dim=1)].double().cpu()
    points = points[:: max(len(points) // MOST_POINTS, 1)]
    if len(points) == 0:
        return Box(torch.full((3,), -0.5).double(), torch.full((3,), 0.5).double())
    low, high = torch.quantile(points, torch.tensor([(1 - BULK) / 2, (1 + BULK) / 2]).double(), dim=0)
    margin = (MARGIN * (high - low)).clamp_min(1e-3)
    return Box(low - margin, high + margin)


def boxes_of(tree: BlockTree, bounds: Box) -> dict[int, Box]:
    """By block, its box within the bounds, a little apart from others; blocks outside are missing."""
    gap, found = GAP * float((bounds.upper - bounds.lower).norm()), {}
    for block in range(tree.num_blocks):
        cell = tree.cell(block)
        lower, upper = torch.maximum(cell.lower, bounds.lower), torch.minimum(cell.upper, bounds.upper)
        if bool((lower < upper).all()):
            inset = torch.clamp((upper - lower) / 4, max=gap / 2)
            found[block] = Box(lower + inset, upper - inset)
    return found


def edges_of(box: Box) -> tuple[tuple[float, float, float], ...]:
    """The twelve edges of a box as one line through its corners, in the viewer's units."""
    low, high = ((SCENE_SCALE * corner).tolist() for corner in (box.lower, box.upper))
    return tuple(tuple((high if c & 4 >> k else low)[k] for k in range(3)) for c in _PATH)
