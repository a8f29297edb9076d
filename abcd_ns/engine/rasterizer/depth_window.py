"""Where along each ray a set of Gaussians shows: the z window of a visit.

Frozen fragments in front of this range and behind it can be drawn once for a visit; those in it have to be
sorted in with the Gaussians that are trained. So the range must hold every fragment that matters, and the
narrower it is, the less is drawn in each step. A cell's own depth range is neither: it leaves out what
reaches out of the cell, and holds much empty space.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.rasterizer.base import DepthWindow
from abcd_ns.engine.rasterizer.binning import Candidates
from abcd_ns.engine.rasterizer.compositing_function import Job, pair_weights
from abcd_ns.engine.rasterizer.splat_kernels import GRADED


@torch.no_grad()
def depth_window(
    candidates: Candidates, planes: Float[Tensor, "r n"], job: Job, visible: float
) -> DepthWindow:
    """The range of camera z, in each tile, in which the Gaussians show.

    Args:
        candidates: of a single crop.
        planes: the splats'.
        job: draws all candidates.
        visible: what the fragments in front of the range, and those behind it, weigh less than, together and
            as a mean over the tile; 0 takes all.
    """
    sheet, (grid,) = candidates.sheet, candidates.sheet.grids
    # Sorted by tile, and within a tile by depth, as pairs come by rank.
    tile, order = candidates.pairs.tile.sort(stable=True)
    z = candidates.depths.index_select(0, candidates.pairs.rank.index_select(0, order))
    drawn = planes[:GRADED].index_select(1, candidates.rows)
    pixels = sheet.to_tiles([planes.new_ones(1, grid.crop.height, grid.crop.width)])[0].sum(dim=0)
    weight = pair_weights(drawn, job).index_select(0, order).double() / pixels.index_select(0, tile)

    ends = torch.bincount(tile, minlength=sheet.tiles).cumsum(0)
    so_far, mass = _from_zero(weight), _from_zero(weight * z)
    starts = torch.cat((ends.new_zeros(1), ends[:-1]))
    before, after = so_far[starts], so_far[ends]
    # With what is in front of each pair, and with what is behind it; rounding must not lose any at 0.
    head = so_far[1:] - before.index_select(0, tile)
    tail = after.index_select(0, tile) - so_far[:-1]
    every = torch.full_like(z, visible <= 0, dtype=torch.bool)
    first, last = (head >= visible) | every, (tail >= visible) | every
    near = z.new_full((sheet.tiles,), math.inf).scatter_reduce(0, tile[first], z[first], "amin")
    far = z.new_full((sheet.tiles,), -math.inf).scatter_reduce(0, tile[last], z[last], "amax")
    near, far, empty = torch.minimum(near, far), torch.maximum(near, far), near.isinf()
    # Half open: the next number after the last depth.
    far = torch.nextafter(far, torch.full_like(far, math.inf))

    held = after - before
    middle = float(mass[-1] / so_far[-1]) if bool(so_far[-1] > 0) else 0.0
    midst = torch.where(held > 0, (mass[ends] - mass[starts]) / held, middle).to(z)
    return DepthWindow(grid, torch.where(empty, midst, near), torch.where(empty, midst, far))


def _from_zero(values: Float[Tensor, "q"]) -> Float[Tensor, "q+1"]:
    """Sums of the first 0, 1, 2, ... values."""
    return torch.cat((values.new_zeros(1), values.cumsum(0)))
