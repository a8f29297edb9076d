"""How much a view shows of a block, and so which views are worth training it on.

The influence of a Gaussian on a view is the mean, over the image, of its weight alpha T in each pixel: what
it adds to the picture once everything before it is taken into account. Influences of all Gaussians and of
the background add up to 1. It is the gradient of the picture's sum by the Gaussian's colour, so that one
drawing forward and backward finds it for all of them.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from abcd_ns.engine.gaussians.spherical_harmonics import SH_C0
from abcd_ns.engine.render import Rasterizer, Shot
from abcd_ns.engine.types import Gaussians, View

COARSE, COARSE_SIDE = 2, 80
"""Influences of whole views are found in images that are so many times smaller, and those of large images in
such as are about so many pixels long: what counts is the order of a block's views, and there may be many."""
DIGITS = 6
"""Decimals that are kept: a millionth of the image is less than a pixel."""

Influence = dict[int, dict[int, float]]
"""By block and by view, the influence of the block's Gaussians; of pairs that have any."""


def weights(
    gaussians: Gaussians,
    rasterizer: Rasterizer,
    shot: Shot,
    front: Float[Tensor, "h w"] | None = None,
    *,
    antialiased: bool = False,
) -> Float[Tensor, "n"]:
    """The sum of each Gaussian's weights over the pixels of a shot.

    Args:
        front: transmittance of what lies before everything in the shot; None for nothing.
    """
    # Colours of 1/2 for all, as these are far from the clamp at 0 that would stop the gradient.
    dark = torch.zeros_like(gaussians.features_dc).requires_grad_()
    grey = replace(gaussians.detach(), features_dc=dark)
    (raster,) = rasterizer.draw(grey, [shot], sh_degree=0, antialiased=antialiased)
    red = raster.color[..., 0]
    total = red.sum() if front is None else (front * red).sum()
    if not total.requires_grad:
        return gaussians.means.new_zeros(len(gaussians))
    (found,) = torch.autograd.grad(total, dark)
    return found.flatten(1)[:, 0] / SH_C0


@torch.no_grad()
def weights_by_pixel(
    gaussians: Gaussians, rasterizer: Rasterizer, shot: Shot, *, antialiased: bool = False
) -> Float[Tensor, "h w"]:
    """The sum of the Gaussians' weights in each pixel of a shot, among what is frozen there: a picture of
    them in white, and of nothing else."""
    white = replace(gaussians.detach(), features_dc=torch.full_like(gaussians.features_dc, 0.5 / SH_C0))
    shot = replace(shot, frozen=shot.frozen and shot.frozen.black)
    (raster,) = rasterizer.draw(white, [shot], sh_degree=0, antialiased=antialiased)
    return raster.color[..., 0]


def share_shown(
    gaussians: Gaussians,
    rasterizer: Rasterizer,
    shot: Shot,
    front: Float[Tensor, "h w"] | None,
    *,
    antialiased: bool = False,
) -> float:
    """The influence of some Gaussians on the view of a shot that shows all of them; see `weights`."""
    found = weights(gaussians, rasterizer, shot, front, antialiased=antialiased)
    return round(float(found.sum()) / shot.view.full.pixels, DIGITS)


def influence(
    gaussians: Gaussians,
    owner: Int[Tensor, "n"],
    views: Iterable[View],
    rasterizer: Rasterizer,
    *,
    antialiased: bool = False,
) -> Influence:
    """The influence of every block on every view, from Gaussians that stand for the whole scene.

    Args:
        owner: each Gaussian's block.
    """
    blocks = int(owner.max()) + 1 if len(owner) else 0
    found: Influence = {}
    for view in views:
        small = coarser(view, max(COARSE, max(view.width, view.height) // COARSE_SIDE))
        each = weights(gaussians, rasterizer, Shot(small, small.full), antialiased=antialiased)
        sums = each.new_zeros(blocks).index_add_(0, owner, each) / small.full.pixels
        for block, value in enumerate(sums.tolist()):
            if round(value, DIGITS) > 0:
                found.setdefault(block, {})[view.index] = round(value, DIGITS)
    return found


def coarser(view: View, times: int) -> View:
    """The same camera with an image that is `times` smaller, rounded up to whole pixels."""
    scale = view.K.new_tensor([[1 / times], [1 / times], [1.0]])
    return replace(view, K=view.K * scale, width=-(-view.width // times), height=-(-view.height // times))


def worth_training(views: Mapping[int, float], share: float) -> tuple[int, ...]:
    """The fewest views that hold at least `share` of a block's influence, by increasing index.

    Args:
        views: the block's influence on each view.
    """
    ranked = sorted(views, key=lambda view: (-views[view], view))
    wanted, held = share * sum(views.values()), 0.0
    for count, view in enumerate(ranked):
        if held >= wanted:
            return tuple(sorted(ranked[:count]))
        held += views[view]
    return tuple(sorted(ranked))
