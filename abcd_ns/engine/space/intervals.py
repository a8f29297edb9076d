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

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.render.z_window import TileGrid, ZWindow
from abcd_ns.engine.space.tree import Box
from abcd_ns.engine.types import View


def ray_directions(view: View, grid: TileGrid, device: torch.device | str = "cpu") -> Float[Tensor, "3 t"]:
    """World-space directions of the rays through the tiles' middles, scaled to unit camera z.

    In the view's dtype. Skew is ignored, as gsplat does. A tile's direction does not depend on the crop, bit
    for bit: only elementwise operations are used. With tiles of one pixel these are the pixels' own rays.
    """
    K = view.K
    numbers = torch.cat((view.viewmat[:3, :3].reshape(-1), K[0, 0, None], K[1, 1, None], K[:2, 2]))
    *rotation, fx, fy, cx, cy = numbers.to(device).unbind(0)
    u, v = grid.middles(view.viewmat.dtype, device)
    x, y = ((u - cx) / fx)[None, :], ((v - cy) / fy)[:, None]
    rows = (rotation[k] * x + rotation[3 + k] * y + rotation[6 + k] for k in range(3))
    return torch.stack([row.flatten() for row in rows])


def ray_interval(box: Box, view: View, grid: TileGrid, device: torch.device | str = "cpu") -> ZWindow:
    """The half-open interval of camera z in which each tile's middle ray is inside `box`.

    `near` is -inf where the camera itself is inside the box, so that nothing in front of it is lost.
    Rays that miss the box get the empty interval near = far = +inf, so [-inf, near) is then all of z.
    """
    directions = ray_directions(view, grid, device)
    near = torch.full_like(directions[0], -math.inf)
    far = torch.full_like(directions[0], math.inf)
    numbers = (view.center.tolist(), box.lower.tolist(), box.upper.tolist())
    for direction, c, lower, upper in zip(directions, *numbers, strict=True):
        for plane, box_is_right in ((lower, True), (upper, False)):
            if math.isinf(plane):
                continue
            if (c >= plane) == box_is_right:
                far = torch.minimum(far, _crossing(plane, c, direction))
            else:
                near = torch.maximum(near, _crossing(plane, c, direction))
    # The planes of several axes can pass the ray by in any order: near > far, or a far before the camera.
    empty = near >= far
    return ZWindow(grid, near.masked_fill(empty, math.inf), far.masked_fill(empty, math.inf))


def _crossing(plane: float, center: float, direction: Float[Tensor, "t"]) -> Float[Tensor, "t"]:
    """Camera z at which rays leave the camera's side of x_k = plane; +inf where they never do."""
    leaves = direction < 0 if center >= plane else direction > 0
    # A 0-dimensional tensor, because torch turns float / tensor into a product with the reciprocal. On the
    # CPU, whatever the device: kernels take it as a number.
    offset = torch.tensor(plane - center, dtype=direction.dtype)
    return torch.where(leaves, offset / direction, math.inf)
