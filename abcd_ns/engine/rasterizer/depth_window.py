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

from abcd_ns.engine.rasterizer.base import ZWindow
from abcd_ns.engine.rasterizer.binning import Candidates
from abcd_ns.engine.rasterizer.compositing_function import Job, pair_weights
from abcd_ns.engine.rasterizer.splat_kernels import GRADED


@torch.no_grad()
def depth_window(candidates: Candidates, planes: Float[Tensor, "r n"], job: Job, visible: float) -> ZWindow:
    """The range of camera z, in each tile, of the fragments that show.

    Args:
        candidates: of a single crop.
        planes: the splats'.
        job: draws all candidates.
        visible: the mean weight over a tile from which on a pair counts; 0 takes all pairs.
    """
    sheet, pairs = candidates.sheet, candidates.pairs
    drawn = planes[:GRADED].index_select(1, candidates.rows)
    weight = pair_weights(drawn, job) / sheet.pixels_per_tile
    z = candidates.depths.index_select(0, pairs.rank)
    shows = weight >= visible
    tile, depth = pairs.tile[shows], z[shows]
    near = z.new_full((sheet.tiles,), math.inf).scatter_reduce(0, tile, depth, "amin")
    far = z.new_full((sheet.tiles,), -math.inf).scatter_reduce(0, tile, depth, "amax")
    # Half open: the next number after the last depth.
    far = torch.nextafter(far, torch.full_like(far, math.inf))

    held = z.new_zeros(sheet.tiles).index_add_(0, pairs.tile, weight)
    moment = z.new_zeros(sheet.tiles).index_add_(0, pairs.tile, weight * z)
    middle = moment.sum() / held.sum() if bool(held.sum() > 0) else moment.sum()
    midst = torch.where(held > 0, moment / held, middle)
    empty = near >= far
    window = torch.stack((torch.where(empty, midst, near), torch.where(empty, midst, far)))
    (image,) = sheet.to_images(window[:, None].expand(2, sheet.pixels_per_tile, sheet.tiles))
    return ZWindow(*image.contiguous())
