"""Blocks as boxes. The outermost cells are infinite, so boxes are cut to the bulk of the points."""

import numpy as np
import torch
from jaxtyping import Float, UInt32
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

_CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=np.float32)
_TRIANGLES = ("013", "032", "467", "475", "045", "051", "237", "276", "026", "064", "157", "173")
_FACES = np.array([[int(corner) for corner in triangle] for triangle in _TRIANGLES], dtype=np.uint32)
"""Of a box with these corners, as triangles that look outward."""


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


def frame_mesh(box: Box, thickness: float) -> tuple[Float[np.ndarray, "v 3"], UInt32[np.ndarray, "f 3"]]:
    """The twelve edges of a box as beams: vertices in the viewer's units, and triangles.

    Lines would be simpler, but their options differ between versions of viser.

    Args:
        thickness: of a beam, world units.
    """
    low, high = box.lower.numpy(), box.upper.numpy()
    beams = []
    for axis in range(3):
        for corner in _CORNERS[_CORNERS[:, axis] == 0]:
            start = np.where(corner > 0, high, low)
            stop = start.copy()
            stop[axis] = high[axis]
            beams.append((start - thickness / 2, stop + thickness / 2))
    vertices = np.concatenate([start + _CORNERS * (stop - start) for start, stop in beams])
    faces = np.concatenate([_FACES + 8 * k for k in range(len(beams))])
    return (vertices * SCENE_SCALE).astype(np.float32), faces.astype(np.uint32)
