"""From where on a scene is drawn: no nearer than any photo shows anything.

Gaussians right before a camera cover all of its picture. In a view that is trained on they are soon gone; a
view that is not, from a place that no photo was taken from, may be lost to a handful of them, though each
is a fair guess at what other views show there. Photos do tell how near things come to a camera.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.types import NEAR_PLANE, View

SHARE = 0.5
"""The near plane, as a share of the distance of the nearest point that a view sees."""
OUTLIERS = 0.001
"""Share of the points that a view sees which may be nearer: wrong matches."""
MOST_POINTS, MOST_VIEWS = 20_000, 500
"""Of more than these, an evenly spaced choice is looked at."""


def near_plane(points: Float[Tensor, "n 3"], views: Sequence[View]) -> float:
    """A near plane for all views of a scene: half the nearest distance at which any sees a point.

    Args:
        points: of the sparse reconstruction, world units.
        views: what is nearer than their own near planes is not looked at.

    Returns:
        Camera z, world units; gsplat's own where there is nothing to tell by, and never less.
    """
    points = points[:: -(-len(points) // MOST_POINTS) or 1].double()
    nearest = math.inf
    for view in views[:: -(-len(views) // MOST_VIEWS) or 1]:
        depths, seen = view.depths_of(points)
        if bool(seen.any()):
            nearest = min(nearest, float(torch.quantile(depths[seen], OUTLIERS)))
    return max(SHARE * nearest, NEAR_PLANE) if math.isfinite(nearest) else NEAR_PLANE


def with_near_plane(views: Sequence[View], points: Float[Tensor, "n 3"], near: float = 0.0) -> list[View]:
    """The views as a scene is trained with them.

    Args:
        points: see `near_plane`.
        near: from where on they see, world units; 0 finds that by the points.
    """
    near = near or near_plane(points, views)
    return [replace(view, near=near) for view in views]
