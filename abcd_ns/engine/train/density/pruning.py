"""Pruning: remove a Gaussian whose contribution to its views is below the minimum.

What a Gaussian weighs in a picture is the sum over pixels of alpha T, the transmittance of whatever lies
before its block included: so many pixels it fills. Drawings that train it tell for nothing, see
`with_blend_weights`. RadSplat (Niemeyer et al., 2024) prunes by the largest of such weights and LightGaussian
(Fan et al., NeurIPS 2024) by their sum when training ends. Here Gaussians go while it goes on, by the sum, at
a minimum that rises until growth ends.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import compress
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from abcd_ns.engine.layers.surface import NEARER
from abcd_ns.engine.render import Raster, Rasterizer, Shot
from abcd_ns.engine.space.influence import weights
from abcd_ns.engine.space.visibility import widest_slant
from abcd_ns.engine.train.schedule import evenly
from abcd_ns.engine.types import NEAR_PLANE, Gaussians, View, centers_of

BLEND_SUMS = ("weight", "passes")
"""What is added up for each Gaussian: its weight, px, and how often it was drawn in all the views that it is
trained on; a drawing of one of n views is 1/n of a pass. A reduced picture's pixel counts as one."""
FULL_PASS = 0.999
"""Of a pass, in sums that are rounded."""
LAST = 0.7
"""Share of the run after which nothing that fills anything goes, nor a block grows for being new."""
FAINT, FAINTER = 0.1, 0.25
"""What fills more than most is a floater if its opacity is below the first, and this share of the median."""
SHOWN = 0.003
"""Share of what a Gaussian would fill if nothing hid it that it must. Photos say next to nothing of one that
they show less of, and where nothing hides it, it may veil a picture."""
FOG, SEEN_THROUGH = 0.5, 0.5
"""Share of what a Gaussian fills that may be fog, see layers/surface.py, where its opacity is below the
second. Photos agree on no surface there."""
MOST_VIEWS = 64
"""As many of a block's views tell what would fill them."""
LEAST_DET = 1e-12
"""Of the inverse of a covariance, px^-4, at least."""
PASSES = 4
"""A block that is the whole scene is judged whenever each of its views was drawn so often."""


class _BlendWeight(torch.autograd.Function):
    """The colour as it is; whatever the loss, the depth's gradient is what a pixel counts for."""

    @staticmethod
    def forward(ctx: Any, color: Tensor, depth: Tensor, counts: Tensor) -> Tensor:  # noqa: ARG004
        ctx.save_for_backward(counts)
        return color.view_as(color)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, None]:
        return grad, ctx.saved_tensors[0], None


def with_blend_weights(raster: Raster, in_front: Float[Tensor, "h w"] | None, share: float) -> Raster:
    """The same drawing, made with `blend_weights`, whose backward leaves in `info["weights"].grad` what each
    Gaussian weighs, by the transmittance `in_front` and the share of pixels that are drawn."""
    counts = torch.ones_like(raster.depth) if in_front is None else in_front.to(raster.depth)
    color = _BlendWeight.apply(raster.color, raster.depth, counts.detach() / share)
    return Raster(color, raster.transmittance, raster.depth, raster.info)


def blend_sums(infos: Sequence[Mapping[str, Any]], views: int) -> dict[str, Tensor]:
    """What drawings add to a block's BLEND_SUMS, each [n], after backward; {} if made without weighing."""
    found = [info["weights"].grad for info in infos if "weights" in info]
    if not found or any(weights is None for weights in found):
        return {}
    weight = torch.cat(found).sum(dim=0)
    passes = torch.full_like(weight, sum(len(weights) for weights in found) / views)
    # An accelerator may have skipped a step that was no number.
    return dict(zip(BLEND_SUMS, (weight.nan_to_num(0.0, 0.0, 0.0), passes), strict=True))


def have_contributions(growth: Mapping[str, Tensor]) -> bool:
    """Whether the statistics say anything of weights."""
    return all(name in growth for name in BLEND_SUMS)


def contributions(growth: Mapping[str, Tensor]) -> Float[Tensor, "n"]:
    """Pixels that each fills in all of its block's views, by BLEND_SUMS; NaN until it was drawn in all."""
    weight, passes = (growth[name] for name in BLEND_SUMS)
    return torch.where(passes >= FULL_PASS, weight / passes, torch.nan)


def faded(growth: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The statistics when all have been judged: what is seen from now on soon counts for more."""
    if not have_contributions(growth):
        return dict(growth)
    half = torch.where(growth["passes"] >= FULL_PASS, 0.5, 1.0)
    return {name: value * half if name in BLEND_SUMS else value for name, value in growth.items()}


def floaters(growth: Mapping[str, Tensor], opacities: Float[Tensor, "n"], faint: float) -> Bool[Tensor, "n"]:
    """Which Gaussians fill more of their block's views than the mean, and have opacities, after the sigmoid,
    below `faint` and FAINTER of their median: clouds before cameras that imitate the light of photos."""
    full = contributions(growth)
    return (opacities < (FAINTER * opacities.median()).clamp(max=faint)) & (full > full.nanmean())


def veils(
    views: Sequence[View], gaussians: Gaussians, rasterizer: Rasterizer, antialiased: bool
) -> Float[Tensor, "n"]:
    """Pixels that each Gaussian would fill of all views from before their near planes. A run draws nothing
    there; other viewers, which get only a file, do."""
    ends = [(NEAR_PLANE, view.near) for view in views]
    return _filled_within(views, ends, gaussians, rasterizer, antialiased)


def fog(
    views: Sequence[View], gaussians: Gaussians, rasterizer: Rasterizer, antialiased: bool
) -> Float[Tensor, "n"]:
    """Pixels that each Gaussian fills of all views from before what their photos are known to show, about."""
    some = evenly(views, MOST_VIEWS)
    ends = [(view.near, NEARER * view.nearest) for view in some]
    return _filled_within(some, ends, gaussians, rasterizer, antialiased) * (len(views) / len(some))


def _filled_within(
    views: Sequence[View],
    ends: Sequence[tuple[float, float]],
    gaussians: Gaussians,
    rasterizer: Rasterizer,
    antialiased: bool,
) -> Float[Tensor, "n"]:
    """Pixels that each Gaussian fills of all views where its camera z is between these ends, with nothing
    else drawn."""
    means, found = gaussians.means, gaussians.means.new_zeros(len(gaussians))
    reach, centers = widest_slant(views) * max(far for _, far in ends), centers_of(views)
    low, high = (end.cpu() for end in (means.amin(dim=0) - reach, means.amax(dim=0) + reach))
    within = ((low < centers) & (centers < high)).all(dim=1).tolist()

    def between(view: View, near: float, far: float) -> Bool[Tensor, "n"]:
        matrix = view.viewmat.to(means)
        z = means @ matrix[2, :3] + matrix[2, 3]
        return (z > near) & (z < far)

    some = [(view, *end) for view, end in compress(zip(views, ends, strict=True), within)]
    counts = torch.stack([between(*each).sum() for each in some]).tolist() if some else []  # one wait for all
    for view, near, far in compress(some, counts):
        (which,) = torch.where(between(view, near, far))
        shot = Shot(replace(view, near=near), view.full)  # nothing else is before them
        found[which] += weights(gaussians[which], rasterizer, [shot], antialiased=antialiased)[0]
    return found


def covered(
    views: Sequence[View], gaussians: Gaussians, rasterizer: Rasterizer, antialiased: bool
) -> Float[Tensor, "n"]:
    """Pixels that each Gaussian would fill of all views if nothing hid it, about; 0 for surfels."""
    means, found = gaussians.means, gaussians.means.new_zeros(len(gaussians))
    some = evenly(views, MOST_VIEWS) if rasterizer.primitive.name == "3dgs" else []
    for view in some:
        splats = rasterizer.project(gaussians, view, antialiased=antialiased)
        xx, xy, yy = splats.shapes.unbind(dim=1)
        det = (xx * yy - xy * xy).clamp_min(LEAST_DET)
        sigmas, middles = (torch.stack((yy, xx)) / det).sqrt(), splats.means2d.T
        size = means.new_tensor([[view.width], [view.height]])
        # Within the image, as if the axes of its ellipse were the image's.
        inside = torch.special.ndtr((size - middles) / sigmas) - torch.special.ndtr(-middles / sigmas)
        pixels = 2 * math.pi * splats.opacities / det.sqrt() * inside.prod(dim=0)
        found += torch.where(splats.radii > 0, pixels, 0.0) * (len(views) / len(some))
    return found


def risen(bound: float, progress: float, growth_ends: float) -> float:
    """What a bound, as `min_contribution`, is at a share of the run: it rises until growth ends. After LAST
    it is 0, as what is missed could not be made good."""
    if progress >= LAST:
        return 0.0
    return bound * min(progress / growth_ends, 1.0) if growth_ends > 0 else bound
