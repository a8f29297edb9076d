"""The first Gaussians: one for each point of a structure-from-motion model, as in 3DGS."""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64, UInt8
from scipy.spatial import cKDTree
from torch import Tensor

from abcd_ns.engine.gaussians.spherical_harmonics import SH_C0
from abcd_ns.engine.types import CHUNK, Gaussians, View

INITIAL_OPACITY = 0.1
THICKNESS = -14.0
"""Logarithm of a surfel's third scale, world units: not drawn here, but it tells viewers that it is flat."""
NEIGHBOURS = 3
"""Other points whose mean distance is a point's size."""
UNSEEN = -1000
"""Level of cubes for points that no view sees: each has its own."""
MOST_VIEWS = 500
"""Of more than these, an evenly spaced choice is looked at."""


@dataclass(frozen=True)
class PointCloud:
    """All in which Gaussians differ before they are trained: 44 bytes of each, where its block has 700."""

    means: Float[Tensor, "n 3"]
    """World space."""
    scales: Float[Tensor, "n 1"]
    """Natural logarithm of the standard deviation along every axis, world units."""
    quats: Float[Tensor, "n 4"]
    features_dc: Float[Tensor, "n 3"]
    sh_degree: int = 3
    flat: bool = False
    """Whether they are discs of THICKNESS."""

    def __len__(self) -> int:
        return len(self.means)

    def __getitem__(self, rows: Tensor | slice) -> "PointCloud":
        return replace(self, **{name: value[rows] for name, value in self.tensors.items()})

    @property
    def tensors(self) -> dict[str, Tensor]:
        """By the names of Gaussians' parameters."""
        return {name: getattr(self, name) for name in ("means", "scales", "quats", "features_dc")}

    def gaussians(self) -> Gaussians:
        count, scales = len(self), self.scales.repeat(1, 3)
        if self.flat:
            scales[:, 2] = THICKNESS
        return Gaussians(
            means=self.means.clone(),
            scales=scales,
            quats=self.quats,
            features_dc=self.features_dc,
            features_rest=self.means.new_zeros(count, (self.sh_degree + 1) ** 2 - 1, 3),
            opacities=self.means.new_full((count, 1), math.log(INITIAL_OPACITY / (1 - INITIAL_OPACITY))),
        )


Points = TypeVar("Points", PointCloud, Gaussians)


def cloud_from_points(
    points: Float[Tensor, "n 3"],
    colors: UInt8[Tensor, "n 3"] | Float[Tensor, "n 3"],
    *,
    sh_degree: int = 3,
    flat: bool = False,
) -> PointCloud:
    """Isotropic Gaussians at `points`, as wide as the mean distance to the three nearest others.

    Args:
        points: world space; rows that are not finite are dropped with a warning. Another warns where the
            points are too few.
        colors: 0..255.
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
    return PointCloud(
        means=points,
        scales=spacing(points).log_()[:, None],
        quats=_random_quats(count).to(points.dtype),
        features_dc=colors.to(points.dtype).div(255).sub_(0.5).div_(SH_C0),
        sh_degree=sh_degree,
        flat=flat,
    )


def spacing(points: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """The mean distance of each point to its three nearest others; never 0: equal points get the smallest
    positive distance there is."""
    if len(points) < 2:
        return points.new_ones(len(points))
    places = points.double().numpy()
    tree, nearest = cKDTree(places), min(NEIGHBOURS + 1, len(places))
    parts = range(0, len(places), CHUNK)
    query = partial(tree.query, k=nearest, workers=torch.get_num_threads())
    found = [query(places[k : k + CHUNK])[0][:, 1:].mean(axis=1) for k in parts]
    least = min((part[part > 0].min(initial=np.inf) for part in found), default=np.inf)
    least = least if np.isfinite(least) else 1.0
    return torch.cat([torch.from_numpy(np.maximum(part, least)).to(points.dtype) for part in found])


def shuffled(count: int, seed: int) -> Int64[Tensor, "n"]:
    """The rows of so many points in the order in which a limit on Gaussians keeps them."""
    return torch.randperm(count, generator=torch.Generator().manual_seed(seed))


def split_off(points: Points, keep: int, seed: int) -> tuple[Points, Points]:
    """A random `keep` of the points, widened to fill the gaps, and the others; all where there are no more.
    A seed always makes the same choice."""
    if keep >= len(points):
        return points, points[:0]
    order = shuffled(len(points), seed)
    chosen, others = points[order[:keep].sort().values], points[order[keep:].sort().values]
    wide = torch.maximum(chosen.scales, spacing(chosen.means).log_()[:, None])
    return replace(chosen, scales=wide), others


def thin_points(
    points: Float[Tensor, "n 3"],
    colors: UInt8[Tensor, "n 3"] | Float[Tensor, "n 3"],
    views: Sequence[View],
    pixels: float,
) -> tuple[Float[Tensor, "m 3"], UInt8[Tensor, "m 3"] | Float[Tensor, "m 3"]]:
    """One point, the mean of place and colour, for all that lie in one small cube.

    A reconstruction is made from photos of full size, and may have dozens of points where the pictures that
    are trained on have one pixel, which no picture can show.

    Cubes have sides of powers of 2: the largest that are no larger than `pixels` pixels of the view that sees
    the point from nearest. Points that no view sees stay as they are.

    Args:
        points: world space.
        pixels: 0 leaves all points as they are.
    """
    count = len(points)
    if pixels <= 0 or count == 0:
        return points, colors
    level, cells = np.empty(count, np.int16), np.empty((3, count))
    for start in range(0, count, CHUNK):
        part, rows = points[start : start + CHUNK], slice(start, start + CHUNK)
        size = pixels * finest_pixel(part, views)
        power, seen = size.clamp_min(1e-30).log2().floor(), size.isfinite()
        level[rows] = torch.where(seen, power, UNSEEN).numpy()
        alone = torch.arange(start, start + len(part)).double()
        cells[:, rows] = torch.where(seen, torch.floor(part.double().T / torch.exp2(power)), alone).numpy()
    order = np.lexsort((*cells[::-1], level))
    begins = np.zeros(count, bool)
    begins[0] = True
    for column in (level, *cells):
        column = column[order]
        begins[1:] |= column[1:] != column[:-1]
    del column, cells, level
    order, owner = torch.from_numpy(order), torch.from_numpy(begins).cumsum(0) - 1
    number = owner.bincount()
    means = (_means_by_owner(values, order, owner, number) for values in (points, colors))
    return tuple(mean.to(points.dtype) for mean in means)


def _means_by_owner(values: Tensor, order: Tensor, owner: Tensor, number: Tensor) -> Float64[Tensor, "m 3"]:
    """The mean of values [n, 3] over each owner's rows: `order` has the rows, those of one owner together,
    `owner` the owner of each place in it, and `number` how many rows each owner has."""
    total = torch.zeros(len(number), 3, dtype=torch.float64)
    for rows, owners in zip(order.split(CHUNK), owner.split(CHUNK), strict=True):
        total.index_add_(0, owners, values[rows].double())
    return total.div_(number[:, None])


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


def _random_quats(count: int) -> Float[Tensor, "n 4"]:
    """Uniform random rotations (Shoemake, "Uniform random rotations", Graphics Gems III); always the same."""
    quats, tau = torch.empty(count, 4), 2 * math.pi
    uniform = torch.rand((3, count), generator=torch.Generator().manual_seed(0))
    for found, (u, v, w) in zip(quats.split(CHUNK), uniform.split(CHUNK, dim=1), strict=True):
        a, b = torch.sqrt(1 - u), torch.sqrt(u)
        v, w = tau * v, tau * w
        torch.stack((a * v.sin(), a * v.cos(), b * w.sin(), b * w.cos()), dim=1, out=found)
    return quats
