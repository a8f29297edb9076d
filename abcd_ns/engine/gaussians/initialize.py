"""The first Gaussians: one for each point of a structure-from-motion model, as in 3DGS."""

import math
import warnings
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, UInt8
from scipy.spatial import cKDTree
from torch import Tensor

from abcd_ns.engine.gaussians.spherical_harmonics import SH_C0
from abcd_ns.engine.types import Gaussians, View

INITIAL_OPACITY = 0.1
THICKNESS = -14.0
"""Logarithm of a surfel's third scale, world units: not drawn here, but it tells viewers that it is flat."""
NEIGHBOURS = 3
"""Other points whose mean distance is a point's size."""
MOST_VIEWS = 500
"""Of more than these, an evenly spaced choice is looked at."""


def gaussians_from_points(
    points: Float[Tensor, "n 3"],
    colors: UInt8[Tensor, "n 3"] | Float[Tensor, "n 3"],
    *,
    sh_degree: int = 3,
    seed: int = 0,
    flat: bool = False,
) -> Gaussians:
    """Isotropic Gaussians at `points`, as wide as the mean distance to the three nearest others.

    Args:
        points: world space; rows that are not finite are dropped with a warning. Another warns where the
            points are too few.
        colors: 0..255.
        seed: of the random rotations.
        flat: make them discs of THICKNESS.
    """
    keep = torch.isfinite(points).all(dim=1)
    if not bool(keep.all()):
        warnings.warn(f"dropped {int((~keep).sum())} initial points that are not finite", stacklevel=2)
        points, colors = points[keep], colors[keep]
    count = points.shape[0]
    elsewhere = int((points != points[:1]).any(dim=1).sum())
    if elsewhere < NEIGHBOURS:
        warnings.warn(
            f"{count} initial points, {elsewhere} of them not where the first is: too few to tell how large "
            "Gaussians should be, and to grow a scene from; look at how the poses were found",
            stacklevel=2,
        )
    generator = torch.Generator().manual_seed(seed)
    scales = spacing(points).log()[:, None].repeat(1, 3)
    if flat:
        scales[:, 2] = THICKNESS
    return Gaussians(
        means=points.clone(),
        scales=scales,
        quats=_random_quats(count, generator).to(points.dtype),
        features_dc=(colors.to(points.dtype) / 255 - 0.5) / SH_C0,
        features_rest=points.new_zeros(count, (sh_degree + 1) ** 2 - 1, 3),
        opacities=points.new_full((count, 1), math.log(INITIAL_OPACITY / (1 - INITIAL_OPACITY))),
    )


def spacing(points: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """The mean distance of each point to its three nearest others; never 0: equal points get the smallest
    positive distance there is."""
    if len(points) < 2:
        return points.new_ones(len(points))
    places = points.double().numpy()
    distance = cKDTree(places).query(places, k=min(NEIGHBOURS + 1, len(places)))[0][:, 1:].mean(axis=1)
    positive = distance[distance > 0]
    least = positive.min() if len(positive) else 1.0
    return torch.from_numpy(np.maximum(distance, least)).to(points.dtype)


def split_off(gaussians: Gaussians, keep: int, seed: int) -> tuple[Gaussians, Gaussians]:
    """A random `keep` of freshly initialised Gaussians, widened to fill the gaps, and the others."""
    order = torch.randperm(len(gaussians), generator=torch.Generator().manual_seed(seed))
    chosen, others = gaussians[order[:keep].sort().values], gaussians[order[keep:].sort().values]
    wide = torch.maximum(chosen.scales, spacing(chosen.means).log()[:, None])
    return replace(chosen, scales=torch.where(chosen.scales == THICKNESS, THICKNESS, wide)), others


def thin_out(gaussians: Gaussians, limit: int | None, seed: int) -> Gaussians:
    """Freshly initialised Gaussians, no more than `limit`: all of them, or a random choice, widened to fill
    the gaps, so that a scene with fewer Gaussians than points is covered all the same.

    Density control never adds above the limit, but it removes only what is faint or huge.

    Args:
        limit: None for no limit.
        seed: the same one makes the same choice.
    """
    if limit is None or len(gaussians) <= limit:
        return gaussians
    return split_off(gaussians, limit, seed)[0]


def thin_points(
    points: Float[Tensor, "n 3"], colors: Float[Tensor, "n 3"], views: Sequence[View], pixels: float
) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 3"]]:
    """One point, the mean of place and colour, for all that lie in one small cube.

    A reconstruction is made from photos of full size, and may have dozens of points where the pictures that
    are trained on have one pixel. What is finer than half a pixel's width no picture can show, by sampling
    theory, and in practice what is finer than the rasterizer's low-pass filter, of some pixel's width.

    Cubes have sides of powers of 2: the largest that are no larger than `pixels` pixels of the view that sees
    the point from nearest. Points that no view sees stay as they are.

    Args:
        points: world space.
        pixels: 0 leaves all points as they are.
    """
    if pixels <= 0 or len(points) == 0:
        return points, colors
    size = pixels * finest_pixel(points, views)
    level = torch.where(size.isfinite(), size.clamp_min(1e-30).log2().floor(), -100.0)
    cells = torch.floor(points.double() / torch.exp2(level)[:, None])
    alone = torch.where(size.isfinite(), -1.0, torch.arange(len(points)).double())
    keys = torch.cat((level[:, None], alone[:, None], cells * size.isfinite()[:, None]), dim=1)
    _, owner, count = torch.unique(keys, dim=0, return_inverse=True, return_counts=True)
    means = [
        values.new_zeros(len(count), 3, dtype=torch.float64).index_add_(0, owner, values.double())
        for values in (points, colors)
    ]
    return tuple((total / count[:, None]).to(points.dtype) for total in means)


def finest_pixel(points: Float[Tensor, "n 3"], views: Sequence[View]) -> Float[Tensor, "n"]:
    """How wide a pixel is at each point, world units, in the view that sees it from nearest; infinite where
    none does."""
    finest = points.new_full((len(points),), torch.inf, dtype=torch.float64)
    for view in views[:: -(-len(views) // MOST_VIEWS) or 1]:
        z, seen = view.depths_of(points)
        pixel = (z / view.K[0, 0].to(points)).double()
        finest = torch.where(seen, torch.minimum(finest, pixel), finest)
    return finest


def random_points(count: int, extent: float, seed: int = 0) -> tuple[Tensor, Tensor]:
    """`count` points uniform in a cube of side `extent` around the origin, and random colours 0..255."""
    generator = torch.Generator().manual_seed(seed)
    points = (torch.rand((count, 3), generator=generator) - 0.5) * extent
    return points, torch.rand((count, 3), generator=generator) * 255


def _random_quats(count: int, generator: torch.Generator) -> Tensor:
    """Uniform random rotations (Shoemake, "Uniform random rotations", Graphics Gems III)."""
    u, v, w = torch.rand((3, count), generator=generator)
    a, b = torch.sqrt(1 - u), torch.sqrt(u)
    tau = 2 * math.pi
    return torch.stack(
        [a * torch.sin(tau * v), a * torch.cos(tau * v), b * torch.sin(tau * w), b * torch.cos(tau * w)],
        dim=1,
    )
