"""What gsplat has drawn for several cameras, and the pictures that are made of it in one go."""

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from abcd_ns.engine.render.base import Raster, Shown, Surroundings
from abcd_ns.engine.render.cuda import fused


class Drawn(Raster):
    """A crop of one camera's part of a sheet, which is cut out when somebody asks for it.

    Args:
        features, alphas: of all cameras; colour and depth, and how much they hide.
        camera: whose part it is.
        part: rows and columns of the crop.
    """

    def __init__(
        self,
        features: Float[Tensor, "c h w 4"],
        alphas: Float[Tensor, "c h w 1"],
        camera: int,
        part: tuple[slice, slice],
        info: dict[str, Any],
    ) -> None:
        self.__dict__.update(features=features, alphas=alphas, camera=camera, part=part, info=info)

    @cached_property
    def _features(self) -> Float[Tensor, "h w 4"]:
        return self.features[self.camera][self.part]

    @cached_property
    def color(self) -> Float[Tensor, "h w 3"]:
        return self._features[..., :3]

    @cached_property
    def depth(self) -> Float[Tensor, "h w"]:
        return self._features[..., 3]

    @cached_property
    def transmittance(self) -> Float[Tensor, "h w"]:
        return 1.0 - self.alphas[self.camera][self.part][..., 0]


class _Pictures(torch.autograd.Function):
    """Pictures that one kernel has made of a sheet, and another one's gradient."""

    @staticmethod
    def forward(
        ctx: Any, features: Tensor, alphas: Tensor, shown: Sequence[Shown], found: list[Tensor]
    ) -> tuple[Tensor, ...]:
        ctx.save_for_backward(features, alphas)
        ctx.shown = shown
        return tuple(found)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        return *fused.between(*ctx.saved_tensors, ctx.shown, gradients), None, None


def pictures_of(
    rasters: Sequence[Raster], around: Sequence[Surroundings]
) -> tuple[Float[Tensor, "_h _w 3"], ...] | None:
    """Pictures of rasters, all of one `draw`, 0..1; None where no kernel can tell."""
    sheets: dict[int, list[int]] = {}
    for k, raster in enumerate(rasters):
        if not isinstance(raster, Drawn):
            return None
        sheets.setdefault(id(raster.features), []).append(k)
    pictures: dict[int, Tensor] = {}
    for places in sheets.values():
        of, shown = rasters[places[0]], [(rasters[k].part, around[k]) for k in places]
        found = fused.between(of.features, of.alphas, shown)
        if found is None:
            return None
        pictures.update(zip(places, _Pictures.apply(of.features, of.alphas, shown, found), strict=True))
    return tuple(pictures[k] for k in range(len(rasters)))
