"""Which blocks can be seen where, by their bounds alone: what cannot be seen is neither read nor drawn.

A block's bounds are a few numbers, known once the block was read. Without them, one visit in a large scene
would read every block of it for every part of space that it draws.
"""

from collections.abc import Iterable, Sequence

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from abcd_ns.engine.space.tree import EVERYWHERE, Box, in_float64
from abcd_ns.engine.space.visibility import reach_radius, widest_slant, world_size
from abcd_ns.engine.types import Crop, Gaussians, View, centers_of

BOUNDS_SLANT = 3.0
"""The largest `widest_slant` that bounds allow for: fields of view up to about 140 degrees."""
ROUNDING = 2.0
"""Frusta are this much wider than what they must hold, px; generously."""


def bounds_of(gaussians: Gaussians) -> Box | None:
    """A box that holds the means and, but for the screen's slack, all that any view may draw of them.

    None without Gaussians; all of space where a mean or a size is not finite.
    """
    if len(gaussians) == 0:
        return None
    means = in_float64(gaussians.means).cpu()
    radius = BOUNDS_SLANT * in_float64(reach_radius(gaussians.scales)).cpu()[:, None]
    lower, upper = (means - radius).amin(dim=0), (means + radius).amax(dim=0)
    if not bool((lower.isfinite() & upper.isfinite()).all()):
        return EVERYWHERE
    return Box(lower, upper)


def united(a: Box | None, b: Box | None) -> Box | None:
    """The smallest box that holds both."""
    if a is None or b is None:
        return a or b
    return Box(torch.minimum(a.lower, b.lower), torch.maximum(a.upper, b.upper))


class Frusta:
    """What some crops look at: the space between five planes each, kept on the CPU.

    Args:
        slack: of the rasterizer, px.
    """

    def __init__(self, seen: Iterable[tuple[View, Crop]], slack: float) -> None:
        self.seen = tuple(seen)
        self._planes = _planes(self.seen, ROUNDING + slack)

    def may_show(self, boxes: Sequence[Box]) -> Bool[Tensor, "n v"]:
        """Whether something in each box may be drawn in each crop; False is certain.

        A box is out of sight if all its corners are beyond one of the planes.
        """
        if not boxes:
            return torch.zeros(0, len(self.seen), dtype=torch.bool)
        corners = _corners(torch.stack([torch.stack((box.lower, box.upper)) for box in boxes]))
        inward = torch.einsum("nca,vpa->nvpc", corners, self._planes[..., :3]) + self._planes[..., 3:]
        # A corner without end may give NaN, which is not below 0: then the box may show.
        return ~(inward < 0).all(dim=3).any(dim=2)

    def hold(self, points: Float[Tensor, "n 3"], rows: Sequence[int]) -> Bool[Tensor, "r"]:
        """Whether any of the points is inside, of the frusta at `rows`."""
        planes = self._planes[list(rows)]
        inward = torch.einsum("na,vpa->pnv", in_float64(points).cpu(), planes[..., :3])
        return (inward + planes[..., 3].T[:, None]).amin(dim=0).amax(dim=0) >= 0


def _planes(seen: Sequence[tuple[View, Crop]], margin: float) -> Float64[Tensor, "v 5 4"]:
    """(a, b) of each plane, a x + b >= 0 being the side that is seen."""
    if not seen:
        return torch.zeros(0, 5, 4, dtype=torch.float64)
    views, crops = zip(*seen, strict=True)
    matrices, K = (
        in_float64(torch.stack([getattr(view, name) for view in views])).cpu() for name in ("viewmat", "K")
    )
    starts, sizes = torch.tensor(crops, dtype=torch.float64)[..., None].split(2, dim=1)
    z = matrices[:, 2]
    near = z.clone()
    near[:, 3] -= torch.tensor([view.near for view in views], dtype=torch.float64)
    planes = [near]
    for axis in range(2):
        # The pixel's coordinate times z.
        pixel = K[:, axis, axis, None] * matrices[:, axis] + K[:, axis, 2, None] * z
        planes.append(pixel - (starts[:, axis] - margin) * z)
        planes.append((starts[:, axis] + sizes[:, axis] + margin) * z - pixel)
    return torch.stack(planes, dim=1)


def _corners(boxes: Float64[Tensor, "n 2 3"]) -> Float64[Tensor, "n 8 3"]:
    choice = torch.cartesian_prod(*[torch.arange(2)] * 3)
    return torch.stack([boxes[:, choice[:, axis], axis] for axis in range(3)], dim=2)


class Optics:
    """Bounds over all views, for tests of reach that do not depend on the view.

    Args:
        slack: of the rasterizer, px.
    """

    def __init__(self, views: Sequence[View], slack: float) -> None:
        centers = centers_of(views)
        self._middle = centers.mean(dim=0)
        self._spread = float((centers - self._middle).norm(dim=1).max())
        self._widest = min(views, key=lambda view: float(view.K.diagonal()[:2].min()))
        self._pixels = slack
        self.slant = max(widest_slant(view) for view in views)

    def slack(self, means: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """What the screen adds to the reach of Gaussians with these means, as the farthest camera would see
        it; world units."""
        distance = (means - self._middle.to(means)).norm(dim=1) + self._spread
        return world_size(self._pixels, distance, self._widest)

    def drawn_within(self, bounds: Box) -> Box:
        """Where fragments of Gaussians with these bounds may lie, whatever the view; the slack included."""
        if self.slant > BOUNDS_SLANT or not bool(bounds.lower.isfinite().all()):
            return EVERYWHERE
        # The slack grows with the distance from a point, which is largest at a corner.
        corners = _corners(torch.stack((bounds.lower, bounds.upper))[None])[0]
        return bounds.grown(float(self.slack(corners).max()))
