"""What a primitive is to gsplat: how cameras project it, how it moves on screen, how it is drawn."""

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from gsplat.cuda._wrapper import (
    fully_fused_projection,
    fully_fused_projection_2dgs,
    rasterize_to_pixels,
    rasterize_to_pixels_2dgs,
)
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.render.projection import PrimitiveName
from abcd_ns.engine.types import Gaussians, View

OnScreen = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor | None]
"""radii, means2d, depths, shapes and centers as in Projected, and compensations of opacities."""


class Kind(NamedTuple):
    """A primitive's three functions."""

    shape: int
    """Numbers of a shape."""
    place: Callable[..., OnScreen]
    """Gaussians in the images of cameras: world to camera, and intrinsics; a view that has their size and
    near plane; and whether opacities are compensated."""
    moved: Callable[[Tensor, Tensor], Tensor]
    """Shapes [m, s] where pixels are counted from another corner, [2] or [m, 2]."""
    draw: Callable[..., tuple[Tensor, Tensor]]
    """Features and alphas of means2d, shapes, features and opacities; the rest as in gsplat's
    `rasterize_to_pixels`."""


def _place_splats(
    gaussians: Gaussians, cameras: tuple[Tensor, Tensor], like: View, antialiased: bool
) -> OnScreen:
    """Shapes are conics."""
    radii, means2d, depths, conics, compensations = fully_fused_projection(
        gaussians.means,
        None,
        gaussians.quats,
        gaussians.scales.exp(),
        *cameras,
        like.width,
        like.height,
        near_plane=like.near,
        packed=False,
        calc_compensations=antialiased,
    )
    return radii, means2d, depths, conics, means2d, compensations


def _place_surfels(
    gaussians: Gaussians, cameras: tuple[Tensor, Tensor], like: View, _antialiased: bool
) -> OnScreen:
    """Shapes are the center and the matrix of surfel_kernels, (u, v, A, B, C, D, E, F).

    The boxes' middles are found anew: gsplat's own gradient of theirs lacks some terms.
    """
    radii, _, depths, rays, _ = fully_fused_projection_2dgs(
        gaussians.means,
        gaussians.quats,
        gaussians.scales.exp(),
        *cameras,
        like.width,
        like.height,
        near_plane=like.near,
        packed=False,
    )
    matrix = rays / rays[..., 2:, 2:]
    centers, (a, b), (c, d), (e, f) = (
        matrix[..., :2, 2],
        matrix[..., 0, :2].unbind(-1),
        matrix[..., 1, :2].unbind(-1),
        matrix[..., 2, :2].unbind(-1),
    )
    u, v = matrix[..., :2, 2].unbind(-1)  # anew: these are no part of what `centers` gets as its gradient
    distance = e * e + f * f - 1
    off = ((a - u * e) * e + (b - u * f) * f, (c - v * e) * e + (d - v * f) * f)
    means2d = torch.stack((u + off[0] / distance, v + off[1] / distance), dim=-1)
    shapes = torch.cat((centers, torch.stack((a, b, c, d, e, f), dim=-1)), dim=-1)
    return radii, means2d, depths, shapes, centers, None


def _moved_surfels(shapes: Float[Tensor, "m 8"], by: Float[Tensor, "*m 2"]) -> Float[Tensor, "m 8"]:
    x, y = by[..., :1], by[..., 1:]
    center, across, down, away = shapes.split(2, dim=-1)
    return torch.cat((center - by, across - x * away, down - y * away, away), dim=-1)


def _draw_surfels(
    means2d: Tensor, shapes: Tensor, features: Tensor, opacities: Tensor, *lists: Any, **options: Any
) -> tuple[Tensor, Tensor]:
    """gsplat's absolute gradients are of its low-pass filter alone, so nobody asks for them."""
    u, v, a, b, c, d, e, f = shapes.unbind(-1)
    rays = torch.stack((a, b, u, c, d, v, e, f, torch.ones_like(u)), dim=-1).view(-1, 3, 3)
    normals, densify = features.new_zeros((len(features), 3)), torch.zeros_like(means2d)
    drawn = rasterize_to_pixels_2dgs(means2d, rays, features, opacities, normals, densify, *lists, **options)
    return drawn[0], drawn[1]


def kind_of(primitive: PrimitiveName) -> Kind:
    """The functions of a primitive."""
    if primitive == "2dgs":
        return Kind(8, _place_surfels, _moved_surfels, _draw_surfels)
    return Kind(3, _place_splats, lambda shapes, _: shapes, rasterize_to_pixels)
