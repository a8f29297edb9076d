"""What the panel puts into the viewer's scene: boxes of blocks and frusta of cameras."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
import viser
import viser.transforms as vtf
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.space.partition import robust_range
from abcd_ns.engine.space.tree import BlockTree, Box
from abcd_ns.engine.types import View, centers_of
from abcd_ns.viewer.texts import Status

SCENE_SCALE = 10.0  # units of nerfstudio's viewer in a world unit
MARGIN = 0.1  # of the outermost boxes beyond 90% of the points on each axis, as a share of these
GAP = 0.004
"""Between the boxes of neighbours, as a share of the bulk's diagonal: faces that coincide would flicker."""
_PATH = (0, 4, 6, 2, 0, 1, 5, 4, 5, 7, 6, 7, 3, 2, 3, 1)
"""Corners in an order that follows all edges of a box; their bits say which are upper, x first."""
COLORS = {
    Status.UNTRAINED: (150, 150, 160),
    Status.WARM_UP: (190, 170, 110),
    Status.ACTIVE: (255, 190, 40),
    Status.DONE: (40, 190, 140),
    Status.UNDER_OBSERVED: (235, 70, 70),
}
MOST_LABELS = 64  # blocks that get their number in the scene; with more they would hide it
MOST_FRUSTA = 200  # cameras shown at a time; evenly chosen of more
LIFT = 0.15  # how far above a camera a browser looks from at first, as a share of the distance
SEEN_SHARE = 0.05
"""Share of a block's Gaussians that must lie in a view's image for it to count as one that sees the block."""


class Scenery:
    """Boxes and frusta in a viser scene; sends only what changed."""

    def __init__(self, scene: viser.SceneApi, frustum_scale: float) -> None:
        self._scene, self._frustum_scale = scene, frustum_scale
        self._boxes: dict[int, Box] = {}
        self._drawn: dict[int, tuple[Status, bool]] = {}  # by block, its state and whether its box is visible
        self._frusta: list[viser.SceneNodeHandle] = []

    def set_boxes(self, boxes: Mapping[int, Box]) -> None:
        """Replace the boxes, by block; `show_boxes` draws them."""
        self._boxes, self._drawn = dict(boxes), {}

    def show_boxes(self, status: Mapping[int, Status], visible: bool) -> None:
        """Colour the boxes by the states of their blocks."""
        for block, box in self._boxes.items():
            if self._drawn.get(block) != (status[block], visible):
                self._drawn[block] = status[block], visible
                self._draw_box(block + 1, box, status[block], visible)

    def _draw_box(self, number: int, box: Box, status: Status, visible: bool) -> None:
        active, edges = status is Status.ACTIVE, edges_of(box)
        look = {"color": COLORS[status], "line_width": 3.0 if active else 2.0, "visible": visible}
        straight = {"curve_type": "catmullrom", "tension": 0.0, "segments": len(edges) - 1}
        self._scene.add_spline_catmull_rom(f"/abcd/block_{number}", edges, **straight, **look)
        if len(self._boxes) <= MOST_LABELS:
            text = f"{number} {status.value}" if active else str(number)
            position = tuple(((box.lower + box.upper) / 2 * SCENE_SCALE).tolist())
            self._scene.add_label(f"/abcd/label_{number}", text, position=position, visible=visible)

    def show_cameras(self, views: Sequence[View]) -> None:
        """Show frusta of these cameras and no others."""
        for node in self._frusta:
            node.remove()
        step = max(-(-len(views) // MOST_FRUSTA), 1)
        self._frusta = [self._draw_frustum(view) for view in views[::step]]

    def _draw_frustum(self, view: View) -> viser.SceneNodeHandle:
        turn = vtf.SO3.from_matrix(view.viewmat[:3, :3].T.double().cpu().numpy())
        return self._scene.add_camera_frustum(
            f"/abcd/camera_{view.index:05d}",
            fov=2 * math.atan(view.height / 2 / float(view.K[1, 1])),
            aspect=view.width / view.height,
            scale=1.5 * self._frustum_scale,
            color=COLORS[Status.ACTIVE],
            wxyz=turn.wxyz,
            position=(view.center.double().cpu() * SCENE_SCALE).numpy(),
        )


def bulk(means: Float[Tensor, "n 3"]) -> Box:
    """The box that holds the bulk of the points; outliers do not stretch it."""
    low, high = robust_range(means[torch.isfinite(means).all(dim=1)].cpu())
    margin = (MARGIN * (high - low)).clamp_min(1e-3)
    return Box(low - margin, high + margin)


def boxes_of(tree: BlockTree, bounds: Box) -> dict[int, Box]:
    """Boxes by block, cut to the bounds since outer cells are infinite; blocks outside are left out."""
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


def first_look(box: Box, views: Sequence[View]) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Where a browser looks from at first, and at what, in the viewer's units: from above the camera farthest
    from the middle of the box, since from outside, what lies behind the scene would hide it."""
    target = (box.lower + box.upper) / 2
    centers = list(centers_of(views)) if views else [box.upper]
    eye = max(centers, key=lambda center: float((center - target).norm()))
    lift = torch.tensor([0.0, 0.0, LIFT * float((eye - target).norm())]).double()
    return ((eye + lift) * SCENE_SCALE).numpy(), (target * SCENE_SCALE).numpy()


def nearest_view(
    eye: Float[np.ndarray, "3"], forward: Float[np.ndarray, "3"], views: Sequence[View]
) -> View | None:
    """The view nearest to `eye` (viewer's units) and most nearly along `forward`; None without views."""
    if not views:
        return None
    centers = centers_of(views)
    spread = (centers - centers.mean(dim=0)).norm(dim=1).mean().clamp_min(1e-9)
    apart = (centers - torch.from_numpy(eye).double() / SCENE_SCALE).norm(dim=1) / spread
    looks = torch.stack([view.viewmat[2, :3] for view in views]).double().cpu()
    return views[int((apart - looks @ torch.from_numpy(forward).double()).argmin())]


def views_that_see(points: Float[Tensor, "n 3"], views: Sequence[View]) -> list[View]:
    """The views in whose image at least SEEN_SHARE of the points lie, occluded or not."""
    if len(points) == 0:
        return []
    points = points.double().cpu()
    return [view for view in views if float(view.depths_of(points)[1].double().mean()) >= SEEN_SHARE]
