"""From where on a scene is drawn: no nearer than any photo shows anything.

Gaussians right before a camera cover all of its picture. In a view that is trained on they are soon gone; a
view that is not, from a place that no photo was taken from, may be lost to a handful of them, though each
is a fair guess at what other views show there. Photos do tell how near things come to a camera.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from statistics import median

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from abcd_ns.engine.types import NEAR_PLANE, View, centers_of

SHARE = 0.5
"""The near plane, as a share of the distance of the nearest point that a view sees."""
OUTLIERS = 0.001
"""Share of the points that a view sees which may be nearer: wrong matches."""
FARTHER = 4.0
"""Times a view's median depth, at most, is its reach."""
MOST_POINTS, MOST_VIEWS = 20_000, 500
"""Of more than these, an evenly spaced choice is looked at."""


def near_plane(points: Float[Tensor, "n 3"], views: Sequence[View]) -> float:
    """A near plane for all views of a scene: half the nearest distance at which any sees a point.

    Args:
        points: of the sparse reconstruction, world units.

    Returns:
        Camera z, world units; gsplat's own where there is nothing to tell by. Never below NEAR_PLANE of the
        typical distance, where that is less than 1: a scene of two far villages is scaled down to fit.
    """
    depths = [found for _, found in _depths(points, views[:: -(-len(views) // MOST_VIEWS) or 1])]
    if not depths:
        return NEAR_PLANE
    nearest = min(float(torch.quantile(found, OUTLIERS)) for found in depths)
    typical = float(torch.stack([found.median() for found in depths]).median())
    return max(SHARE * nearest, NEAR_PLANE * min(typical, 1.0))


def as_trained(views: Sequence[View], points: Float[Tensor, "n 3"], near: float = 0.0) -> list[View]:
    """The views as a scene is trained with them: from their near plane on, each with its `nearest` and its
    `reach`.

    Args:
        points: see `near_plane`.
        near: from where on they see, world units; 0 finds that by the points.
    """
    near, extent = near or near_plane(points, views), _extent(views)
    found = {
        view.index: (float(torch.quantile(depths, OUTLIERS)), min(extent, FARTHER * float(depths.median())))
        for view, depths in _depths(points, views)
    }
    nothing = 0.0, median(reach for _, reach in found.values()) if found else extent
    seen = ((view, *found.get(view.index, nothing)) for view in views)
    return [replace(view, near=near, nearest=nearest, reach=reach) for view, nearest, reach in seen]


def _extent(views: Sequence[View]) -> float:
    """How far cameras stand from their middle along an axis, world units: the farthest, but at most twice as
    far as the median one. 1 where all stand in one place."""
    centers = centers_of(views)
    away = (centers - centers.median(dim=0).values).abs().amax(dim=1)
    return min(float(away.max()), 2 * float(away.median())) or float(away.max()) or 1.0


def _depths(
    points: Float[Tensor, "n 3"], views: Sequence[View]
) -> Iterator[tuple[View, Float64[Tensor, "_n"]]]:
    """Camera z of the points that each view sees, for those that see any."""
    points = points[:: -(-len(points) // MOST_POINTS) or 1].double()
    for view in views:
        depths, seen = replace(view, near=0.0).depths_of(points)
        if bool(seen.any()):
            yield view, depths[seen]
