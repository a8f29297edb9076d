"""Where the ray through each tile's middle is inside a cell, measured in camera z.

A ray through a point (u, v) of the image, scaled to unit camera z, is c + z d with the camera's centre c and

    d = R^T [(u - cx) / fx, (v - cy) / fy, 1]

so its parameter is camera z itself. It crosses the plane x_k = s at z = (s - c_k) / d_k, if at all.

Cells tile space, and their intervals must tile z just as exactly, or fragments would be drawn twice or
never. Three rules see to that, with no tolerance anywhere:

1. Which side of a plane the camera is on is decided as by BlockTree.assign: in float64, right if c_k >= s.
2. The side with the camera gets [start, crossing), the other one [crossing, end). A ray that runs along
   the plane or away from it never crosses: then the crossing is +inf and the other side gets nothing.
3. Both sides compute the crossing by the same two rounded operations. These are monotone in s, so a
   plane that is redundant for a box stays redundant after rounding.

Hence for any tree, ray and z (z <= 0 too: all of it goes to the camera's cell), exactly one cell's
interval holds z, and along z the cells follow one another in front_to_back order.

One ray serves all pixels of a tile: what is drawn in the tile is then parted by z alike for each of them, and
that is all that folding needs. A fragment may so be given to a cell that its own ray misses, by half a tile's
diagonal at most; tests of reach allow for that (see visibility.py).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.render.z_window import TileGrid, ZWindow
from abcd_ns.engine.space.tree import Box
from abcd_ns.engine.transfer import upload
from abcd_ns.engine.types import View


def ray_directions(view: View, grid: TileGrid, device: torch.device | str = "cpu") -> Float[Tensor, "3 t"]:
    """World-space directions of the rays through the tiles' middles, scaled to unit camera z.

    In the view's dtype. Skew is ignored, as gsplat does. A tile's direction does not depend on the crop, bit
    for bit: only elementwise operations are used. With tiles of one pixel these are the pixels' own rays.
    """
    *rotation, _, _, _, fx, fy, cx, cy = view.numbers[:16].to(device).unbind(0)
    u, v = grid.middles(view.viewmat.dtype, device)
    x, y = ((u - cx) / fx)[None, :], ((v - cy) / fy)[:, None]
    rows = (rotation[k] * x + rotation[3 + k] * y + rotation[6 + k] for k in range(3))
    return torch.stack([row.flatten() for row in rows])


@dataclass(frozen=True)
class Rays:
    """The rays through the middles of a crop's tiles."""

    center: list[float]
    """Of the camera, world space."""
    grid: TileGrid
    directions: Float[Tensor, "3 t"]
    """See ray_directions."""

    @staticmethod
    def of(view: View, grid: TileGrid, device: torch.device | str = "cpu") -> "Rays":
        return Rays(view.center.tolist(), grid, ray_directions(view, grid, device))

    def on(self, grid: TileGrid) -> "Rays":
        """Those of a crop of this crop."""
        return Rays(self.center, grid, self.grid.part(self.directions, grid))


@torch.no_grad()
def ray_interval(box: Box, view: View, grid: TileGrid, device: torch.device | str = "cpu") -> ZWindow:
    """`ray_intervals` of one crop."""
    return ray_intervals(box, [Rays.of(view, grid, device)])[0]


@torch.no_grad()
def ray_intervals(box: Box, rays: Sequence[Rays]) -> list[ZWindow]:
    """The half-open intervals of camera z in which rays are inside `box`; all crops in one pass.

    `near` is -inf where the camera itself is inside the box, so that nothing in front of it is lost.
    Rays that miss the box get the empty interval near = far = +inf, so [-inf, near) is then all of z.
    """
    counts, directions = [one.grid.tiles for one in rays], torch.cat([one.directions for one in rays], dim=1)
    faces = [(axis, at, True) for axis, at in enumerate(box.lower.tolist())]
    faces += [(axis, at, False) for axis, at in enumerate(box.upper.tolist())]
    faces = [face for face in faces if math.isfinite(face[1])]
    if not faces:
        return [ZWindow.everything(one.grid, directions.device, directions.dtype) for one in rays]
    sides = [[_side(one.center[axis], at, is_lower) for axis, at, is_lower in faces] for one in rays]
    of_views = upload(torch.tensor(sides, dtype=directions.dtype), directions.device).unbind(0)
    spread = [side.T[..., None].expand(-1, -1, n) for side, n in zip(of_views, counts, strict=True)]
    offset, ahead, is_far = torch.cat(spread, dim=2)
    along = torch.stack([directions[axis] for axis, *_ in faces])
    # Camera z at which rays leave the camera's side of each plane; +inf where they never do.
    crossing = torch.where(along * ahead > 0, offset / along, math.inf)
    near = torch.where(is_far > 0, -math.inf, crossing).amax(dim=0)
    far = torch.where(is_far > 0, crossing, math.inf).amin(dim=0)
    # The planes of several axes can pass the ray by in any order: near > far, or a far before the camera.
    ends = torch.where(near >= far, math.inf, torch.stack((near, far))).split(counts, dim=1)
    return [ZWindow(one.grid, *both) for one, both in zip(rays, ends, strict=True)]


def _side(center: float, plane: float, box_is_right: bool) -> tuple[float, float, float]:
    """Of a camera and a plane x_k = plane: the way to it along x_k; the sign of what leads there; and 1 where
    the box ends at it, 0 where it begins. Decided in float64, see above."""
    is_right = center >= plane
    return plane - center, -1.0 if is_right else 1.0, float(is_right == box_is_right)
