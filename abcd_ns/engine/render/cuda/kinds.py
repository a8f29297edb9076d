"""What a primitive is to gsplat: how cameras project it, how it moves on screen, how it is drawn."""

from abc import ABC, abstractmethod
from typing import Any

import torch
from gsplat.cuda._wrapper import (
    fully_fused_projection,
    fully_fused_projection_2dgs,
    rasterize_to_pixels,
    rasterize_to_pixels_2dgs,
)
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.render.primitive import PrimitiveName
from abcd_ns.engine.types import Gaussians, View

OnScreen = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor | None]
"""radii, means2d, depths, shapes and centers as in Projected, and compensations of opacities."""


class Kind(ABC):
    """A primitive's three functions."""

    @abstractmethod
    def place(
        self, gaussians: Gaussians, cameras: tuple[Tensor, Tensor], like: View, antialiased: bool
    ) -> OnScreen:
        """Gaussians in the images of cameras.

        Args:
            cameras: world to camera, and intrinsics.
            like: has their size and near plane.
        """

    def moved(self, shapes: Float[Tensor, "m s"], _by: Float[Tensor, "*m 2"]) -> Float[Tensor, "m s"]:
        """Shapes where pixels are counted from another corner."""
        return shapes

    @abstractmethod
    def draw(
        self,
        means2d: Tensor,
        shapes: Tensor,
        features: Tensor,
        opacities: Tensor,
        *lists: Any,
        **options: Any,
    ) -> tuple[Tensor, Tensor]:
        """Features and alphas; the rest as in gsplat's `rasterize_to_pixels`."""


class SplatKind(Kind):
    """3DGS: shapes are conics."""

    def place(
        self, gaussians: Gaussians, cameras: tuple[Tensor, Tensor], like: View, antialiased: bool
    ) -> OnScreen:
        """See Kind."""
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

    def draw(self, *splats: Any, **options: Any) -> tuple[Tensor, Tensor]:
        """See Kind."""
        return rasterize_to_pixels(*splats, **options)


class SurfelKind(Kind):
    """2DGS: shapes are the center and the matrix of surfel_kernels, (u, v, A, B, C, D, E, F)."""

    def place(
        self, gaussians: Gaussians, cameras: tuple[Tensor, Tensor], like: View, _antialiased: bool
    ) -> OnScreen:
        """See Kind. The boxes' middles are found anew: gsplat's own gradient of theirs lacks some terms."""
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
        centers, (a, b), (c, d) = (
            matrix[..., :2, 2],
            matrix[..., 0, :2].unbind(-1),
            matrix[..., 1, :2].unbind(-1),
        )
        (e, f), (u, v) = matrix[..., 2, :2].unbind(-1), matrix[..., :2, 2].unbind(-1)
        distance = e * e + f * f - 1
        off = ((a - u * e) * e + (b - u * f) * f, (c - v * e) * e + (d - v * f) * f)
        means2d = torch.stack((u + off[0] / distance, v + off[1] / distance), dim=-1)
        shapes = torch.cat((centers, torch.stack((a, b, c, d, e, f), dim=-1)), dim=-1)
        return radii, means2d, depths, shapes, centers, None

    def moved(self, shapes: Float[Tensor, "m 8"], by: Float[Tensor, "*m 2"]) -> Float[Tensor, "m 8"]:
        """See Kind."""
        x, y = by[..., :1], by[..., 1:]
        center, across, down, away = shapes.split(2, dim=-1)
        return torch.cat((center - by, across - x * away, down - y * away, away), dim=-1)

    def draw(
        self,
        means2d: Tensor,
        shapes: Tensor,
        features: Tensor,
        opacities: Tensor,
        *lists: Any,
        **options: Any,
    ) -> tuple[Tensor, Tensor]:
        """See Kind. gsplat's absolute gradients are of its low-pass filter alone, so nobody asks for them."""
        u, v, *matrix = shapes.unbind(-1)
        a, b, c, d, e, f = matrix
        rays = torch.stack((a, b, u, c, d, v, e, f, torch.ones_like(u)), dim=-1).view(-1, 3, 3)
        normals, densify = features.new_zeros((len(features), 3)), torch.zeros_like(means2d)
        drawn = rasterize_to_pixels_2dgs(
            means2d, rays, features, opacities, normals, densify, *lists, **options
        )
        return drawn[0], drawn[1]


KINDS: dict[PrimitiveName, Kind] = {"3dgs": SplatKind(), "2dgs": SurfelKind()}
