"""What can be seen where, by bounds alone: what cannot be seen is neither read nor drawn.

A block's bounds are a few numbers, known once the block was read. Without them, one visit in a large scene
would read every block of it for every part of space that it draws.
"""

import math
from collections.abc import Iterable, Sequence

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from abcd_ns.engine.render.projection import DRAWN_SIGMAS
from abcd_ns.engine.space.tree import EVERYWHERE, Box, in_float64
from abcd_ns.engine.types import Crop, Gaussians, View, centers_of

BOUNDS_SLANT = 3.0
"""The largest `widest_slant` that bounds allow for: fields of view up to about 140 degrees."""
ROUNDING = 2.0
"""Frusta are this much wider than what they must hold, px; generously."""
CROP_ALIGN = 16
"""Crops begin and end on multiples of so many pixels, or at the image's edge. These are gsplat's tiles: it
draws a Gaussian on all of each that its square touches."""


def footprint(extent: Sequence[float], view: View, margin: int = 0) -> Crop | None:
    """The smallest aligned crop that holds everything that some projected Gaussians can draw, if it is in the
    image.

    Args:
        extent: where that is: (left, top, right, bottom), px; see Rasterizer.extents. Nowhere where a side
            is beyond its opposite.
        margin: grow by this many px (a loss that looks at neighbouring pixels needs it), before edges are
            aligned.
    """
    x0, y0, x1, y1 = extent
    if x0 > x1 or y0 > y1:
        return None
    x, width = _aligned_span(x0, x1, view.width, margin)
    y, height = _aligned_span(y0, y1, view.height, margin)
    return Crop(x, y, width, height)


def _aligned_span(low: float, high: float, size: int, margin: int) -> tuple[int, int]:
    """(first pixel, number of pixels) of [low, high] grown, aligned outward and clipped to 0 .. size."""
    start = (math.floor(max(low, 0.0)) - margin) // CROP_ALIGN * CROP_ALIGN
    stop = -((-math.ceil(min(high, float(size))) - margin) // CROP_ALIGN) * CROP_ALIGN
    start, stop = max(start, 0), min(stop, size)
    return start, stop - start


def reach_radius(scales: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """DRAWN_SIGMAS standard deviations along each Gaussian's longest axis, world units; `scales` are logs."""
    return DRAWN_SIGMAS * scales.amax(dim=1).exp()


def widest_slant(views: Sequence[View]) -> float:
    """How much longer a Gaussian may be drawn at its own camera z than it is: 1 / cos of the widest angle.

    Splatting projects along the line of sight onto the plane of the mean's camera z: there an offset
    (dx, dy, dz) lands at (dx - dz x/z, dy - dz y/z), longer by sqrt(1 + (x/z)^2 + (y/z)^2) at most. gsplat
    clamps x/z at the image's border plus 0.15 of its width (0.3 tan of half the field of view); y/z alike.
    """
    K = in_float64(torch.stack([view.K for view in views])).cpu()
    size = torch.tensor([(view.width, view.height) for view in views], dtype=torch.float64)
    middle, focal = K[:, :2, 2], K[:, :2, :2].diagonal(dim1=1, dim2=2)
    limits = (torch.maximum(middle, size - middle) + 0.15 * size) / focal
    return float((1 + limits.square().sum(dim=1)).sqrt().max())


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
    """What some crops look at: the space between five planes each, on the CPU. Wider by a rasterizer's slack,
    px."""

    def __init__(self, seen: Iterable[tuple[View, Crop]], slack: float) -> None:
        self.seen, self._margin = tuple(seen), ROUNDING + slack
        self._forms = _forms([view for view, _ in self.seen])
        edges = [(c.x, c.y, c.x + c.width, c.y + c.height) for _, c in self.seen]
        self._edges = torch.tensor(edges, dtype=torch.float64).reshape(-1, 2, 2)
        self._near = torch.tensor([view.near for view, _ in self.seen], dtype=torch.float64)[:, None]

    def may_show(self, boxes: Float64[Tensor, "n 2 3"]) -> Bool[Tensor, "n v"]:
        """Whether something in each box may be drawn in each crop; False is certain.

        A box is out of sight if all its corners are beyond one of the planes.
        """
        return self._look(boxes)[0]

    def crops(
        self, boxes: Float64[Tensor, "n 2 3"], wanted: Bool[Tensor, "n v"]
    ) -> tuple[Bool[Tensor, "n v"], dict[int, Crop]]:
        """`may_show` where that is wanted, and by views' indices the pixels of the crops where it may be."""
        shows, xy, z = self._look(boxes)
        shows &= wanted
        if not len(boxes):
            return shows, {}
        xy = xy / z[:, :, None]
        # A box that reaches behind the camera may be drawn anywhere.
        known = ((z > self._near) & xy.isfinite().all(dim=2)).all(dim=2)
        lower = torch.where(known[..., None], xy.amin(dim=3), -math.inf)
        upper = torch.where(known[..., None], xy.amax(dim=3), math.inf)
        lower = torch.where(shows[..., None], lower, math.inf).amin(dim=0)
        upper = torch.where(shows[..., None], upper, -math.inf).amax(dim=0)
        found = {}
        for row in shows.any(dim=0).nonzero()[:, 0].tolist():
            view, crop = self.seen[row]
            extent = (*lower[row].tolist(), *upper[row].tolist())
            drawn = footprint(extent, view, math.ceil(self._margin))
            if drawn is not None and (shared := drawn.shared(crop)) is not None:
                found[view.index] = shared
        return shows, found

    def _look(self, boxes: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """What `may_show` gives; of the corners, [n v 2 8] pixels times z, and [n v 8] z."""
        corners = torch.einsum("nca,vpa->nvpc", _corners(boxes), self._forms[..., :3]) + self._forms[..., 3:]
        xy, z = corners[:, :, :2], corners[:, :, 2]
        low, high = (
            (self._edges[:, side, :, None] + sign * self._margin) * z[:, :, None]
            for side, sign in ((0, -1), (1, 1))
        )
        beyond = torch.cat((xy < low, xy > high, (z < self._near)[:, :, None]), dim=2)
        # A corner without end may give NaN, which is beyond nothing: then the box may show.
        return ~beyond.all(dim=3).any(dim=2), xy, z


def _forms(views: Sequence[View]) -> Float64[Tensor, "v 3 4"]:
    """A point's pixel times its camera z, and that z, as linear forms of the point."""
    if not views:
        return torch.zeros(0, 3, 4, dtype=torch.float64)
    given = ([view.viewmat for view in views], [view.K for view in views])
    matrices, K = (in_float64(torch.stack(each)).cpu()[..., None] for each in given)
    x, y, z = matrices[:, :3, :, 0].unbind(1)
    return torch.stack((K[:, 0, 0] * x + K[:, 0, 2] * z, K[:, 1, 1] * y + K[:, 1, 2] * z, z), dim=1)


def _corners(boxes: Float64[Tensor, "n 2 3"]) -> Float64[Tensor, "n 8 3"]:
    choice = torch.cartesian_prod(*[torch.arange(2)] * 3)
    return torch.stack([boxes[:, choice[:, axis], axis] for axis in range(3)], dim=2)


class Optics:
    """Bounds over all views and a rasterizer's slack, px, by which reach is tested for all views at once."""

    def __init__(self, views: Sequence[View], slack: float) -> None:
        centers = centers_of(views)
        self._middle = centers.mean(dim=0)
        self._spread = float((centers - self._middle).norm(dim=1).max())
        focal = torch.stack([view.K for view in views]).diagonal(dim1=1, dim2=2)[:, :2]
        self._angle = slack / float(focal.min())
        self.slant = widest_slant(views)

    def slack(self, means: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """What the screen adds to the reach of Gaussians with these means, as the farthest camera would see
        it; world units."""
        return ((means - self._middle.to(means)).norm(dim=1) + self._spread) * self._angle

    def reaches(
        self, means: Float[Tensor, "n 3"], scales: Float[Tensor, "n 3"], box: Box
    ) -> Bool[Tensor, "n"]:
        """Whether any fragment of each Gaussian may lie in `box`, from any of the views: False is certain.

        True where the distance from the mean to the box is at most slant * reach_radius + slack. The slack is
        the screen's blur (at most, as sqrt(a^2 + b^2) <= a + b), and half a tile's diagonal, as a fragment's
        place is looked up on the ray through the middle of its tile.
        """
        outside = torch.maximum(box.lower.to(means) - means, means - box.upper.to(means)).clamp(min=0)
        return outside.norm(dim=1) <= self._reach(means, scales)

    def straddles(
        self, means: Float[Tensor, "n 3"], scales: Float[Tensor, "n 3"], box: Box
    ) -> Bool[Tensor, "n"]:
        """Whether any fragment of each Gaussian may lie outside `box`; see `reaches`."""
        inside = torch.minimum(means - box.lower.to(means), box.upper.to(means) - means).amin(dim=1)
        return ~(inside > self._reach(means, scales))

    def _reach(self, means: Float[Tensor, "n 3"], scales: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        return self.slant * reach_radius(scales) + self.slack(means)

    def drawn_within(self, bounds: Sequence[Box]) -> Float64[Tensor, "n 2 3"]:
        """Where fragments of Gaussians with these bounds may lie, whatever the view; the slack included.
        Boxes, by their lower and upper corners."""
        boxes = torch.stack([torch.stack((box.lower, box.upper)) for box in (*bounds, EVERYWHERE)])
        # The slack grows with the distance from a point, which is largest at a corner.
        slack = self.slack(_corners(boxes).flatten(0, 1)).view(-1, 8).amax(dim=1)
        grown = boxes + slack[:, None, None] * torch.tensor([-1.0, 1.0])[:, None]
        bounded = boxes[:, 0].isfinite().all(dim=1) & (self.slant <= BOUNDS_SLANT)
        return torch.where(bounded[:, None, None], grown, boxes[-1])[:-1]


def shared(boxes: Float64[Tensor, "n 2 3"], box: Box) -> tuple[Bool[Tensor, "n"], Float64[Tensor, "n 2 3"]]:
    """Which boxes have a part within another one, faces included, and these parts."""
    parts = torch.stack((boxes[:, 0].maximum(box.lower), boxes[:, 1].minimum(box.upper)), dim=1)
    return (parts[:, 0] <= parts[:, 1]).all(dim=1), parts
