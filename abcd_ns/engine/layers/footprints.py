"""Which views see a block, and where in the image: what is decided once, when a visit begins."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.kernels.photometric import SSIM_WINDOW
from abcd_ns.engine.render import Rasterizer
from abcd_ns.engine.space.influence import COARSE_SIDE, coarser, in_passes
from abcd_ns.engine.space.visibility import footprint
from abcd_ns.engine.store.special_blocks import BlockName
from abcd_ns.engine.types import Crop, Gaussians, View

CROP_MARGIN = SSIM_WINDOW - 1
"""Pixels added to a footprint, so that every SSIM window that sees the block lies in the crop."""


@dataclass(frozen=True)
class VisitGeometry:
    """What is decided once, when a visit begins, and must be the same after a resume."""

    block: BlockName
    crops: dict[int, Crop]
    """By view index, the pixels to train on; views that do not see the block are missing."""

    @property
    def views(self) -> tuple[int, ...]:
        """Indices of the views that see the block."""
        return tuple(sorted(self.crops))


def footprints(
    gaussians: Gaussians, block: int, views: Iterable[View], rasterizer: Rasterizer, share: float = 1.0
) -> VisitGeometry:
    """Which views see the block's Gaussians, and where in the image. A crop holds a `share` of their weight
    in the picture, with nothing before them: a few wide and faint ones would make it the whole image."""
    views = tuple(views)
    if not views:
        return VisitGeometry(block, {})
    extents = rasterizer.extents(gaussians, views)
    crops = _crops(views, extents)
    if share < 1 and crops:
        seen = [row for row, view in enumerate(views) if view.index in crops]
        views = [views[row] for row in seen]
        most = _extents_of_most(gaussians, views, rasterizer, share)
        drawn = extents[seen].to(most)
        lower, upper = torch.maximum(drawn[:, :2], most[:, :2]), torch.minimum(drawn[:, 2:], most[:, 2:])
        crops |= _crops(views, torch.cat((lower, upper), dim=1))  # all of it where nothing weighs anything
    return VisitGeometry(block, crops)


def _crops(views: Sequence[View], extents: Float[Tensor, "v 4"]) -> dict[int, Crop]:
    """By view index; of those where there is something."""
    pairs = zip(views, extents.tolist(), strict=True)
    found = {view.index: footprint(extent, view, CROP_MARGIN) for view, extent in pairs}
    return {view: crop for view, crop in found.items() if crop is not None}


@torch.no_grad()
def _extents_of_most(
    gaussians: Gaussians, views: Sequence[View], rasterizer: Rasterizer, share: float
) -> Float[Tensor, "v 4"]:
    """Of rectangles that hold a share of the Gaussians' weight in each view, px; found in small pictures of
    them alone."""
    times = [max(max(view.width, view.height) // COARSE_SIDE, 1) for view in views]
    small = [coarser(view, by) for view, by in zip(views, times, strict=True)]
    extents = list[Tensor]()
    for shots in in_passes(gaussians, small):
        rasters = rasterizer.draw(gaussians.detach(), shots, sh_degree=0)
        extents += [extent_of_most(1 - raster.transmittance, share) for raster in rasters]
    return torch.stack(extents).cpu() * torch.tensor(times)[:, None]


def extent_of_most(weight: Float[Tensor, "h w"], share: float) -> Float[Tensor, "4"]:
    """The (left, top, right, bottom) of a rectangle that holds a share of what all pixels weigh: beyond each
    of its sides is a quarter of the rest at most. Its left is right of its right side where nothing weighs
    anything."""
    spared = (1 - share) / 4 * weight.sum()
    lows, highs = [], []
    for side in (0, 1):  # columns, then rows
        sums = weight.sum(dim=side)
        before, behind = sums.cumsum(0), sums.flip(0).cumsum(0)
        lows.append((before <= spared).sum())
        highs.append(len(sums) - (behind <= spared).sum())
    return torch.stack([*lows, *highs]).to(weight)
