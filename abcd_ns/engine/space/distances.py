"""What a capture's points tell of its views: from where on they are drawn, how far and how much they see.

Gaussians right before a camera cover all of its picture. In a view that is trained on they are soon gone; a
view that is not, from a place that no photo was taken from, may be lost to a handful of them, though each
is a fair guess at what other views show there. Photos do tell how near things come to a camera.
"""

from collections.abc import Sequence
from dataclasses import replace
from statistics import median

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.types import NEAR_PLANE, View, centers_of

SHARE = 0.5
"""The near plane, as a share of the distance of the nearest point that a view sees."""
OUTLIERS = 0.001
"""Share of the points that a view sees which may be nearer: wrong matches."""
FARTHER = 4.0
"""Times a view's median depth, at most, is its reach."""
MOST_POINTS = 20_000
"""Of more than these, an evenly spaced choice is looked at."""


def as_trained(views: Sequence[View], points: Float[Tensor, "n 3"], near: float = 0.0) -> list[View]:
    """The views as a scene is trained with them: from one near plane on, each with its `nearest` and `reach`.

    Where no view sees a point the near plane is gsplat's. Else it is at least that, or that times the typical
    distance where it is below 1: a scene of two far villages is scaled down to fit.

    Args:
        points: of the sparse reconstruction, world units.
        near: from where on they see, world units; 0 takes half the nearest distance of a point in any view.
    """
    points = points[:: -(-len(points) // MOST_POINTS) or 1].double()
    extent = _extent(views)
    found: dict[int, tuple[float, float]] = {}
    for view in views:
        depths, seen = replace(view, near=0.0).depths_of(points)
        if bool(seen.any()):
            found[view.index] = float(torch.quantile(depths[seen], OUTLIERS)), float(depths[seen].median())
    if not found:
        return [replace(view, near=near or NEAR_PLANE, reach=extent) for view in views]
    least, typical = min(nearest for nearest, _ in found.values()), median(d for _, d in found.values())
    near = near or max(SHARE * least, NEAR_PLANE * min(typical, 1.0))
    known = ((view, *found.get(view.index, (0.0, typical))) for view in views)
    return [
        replace(view, near=near, nearest=nearest, reach=min(extent, FARTHER * distance))
        for view, nearest, distance in known
    ]


def _extent(views: Sequence[View]) -> float:
    """How far cameras stand from their middle along an axis, world units: the farthest, but at most twice as
    far as the median one. 1 where all stand in one place."""
    centers = centers_of(views)
    away = (centers - centers.median(dim=0).values).abs().amax(dim=1)
    return min(float(away.max()), 2 * float(away.median())) or float(away.max()) or 1.0
