"""Pictures of drawings within their surroundings: by the native library on a CPU, by Triton on CUDA."""

import ctypes
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from abcd_ns.engine.kernels.native import address, library, suits
from abcd_ns.engine.render.base import Raster, Surroundings
from abcd_ns.engine.render.cuda import drawn
from abcd_ns.engine.types import Layer

_LAYER = (ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64, ctypes.c_int64)
"""Colour and transmittance, and how many floats it is from pixel to pixel."""


class _Shown(ctypes.Structure):
    """What lies in front, what is drawn, what lies behind, and the background."""

    _fields_ = tuple((f"_{k}", kind) for k, kind in enumerate((*_LAYER * 3, ctypes.c_void_p)))


class _Between(torch.autograd.Function):
    """A drawing's colour, transmittance and depth -> its picture."""

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> Float[Tensor, "h w 3"]:
        color, transmittance, _, around = inputs
        picture = color.new_empty(color.shape)
        shown, _held = _as_shown(Layer(color, transmittance), around)
        library().abcd_between(transmittance.numel(), shown, address(picture))
        ctx.save_for_backward(color, transmittance)
        ctx.around = around
        return picture

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Float[Tensor, "h w 3"]) -> tuple[Tensor | None, ...]:
        (color, transmittance), gradient = ctx.saved_tensors, gradient.contiguous()
        found = [gradient.new_empty(value.shape) for value in (color, transmittance, transmittance)]
        shown, _held = _as_shown(Layer(color, transmittance), ctx.around)
        into = address(gradient), ctx.around.counts, *map(address, found)
        library().abcd_between_back(transmittance.numel(), shown, *into)
        return *found, None


def pictures_of(
    rasters: Sequence[Raster], around: Sequence[Surroundings]
) -> tuple[Float[Tensor, "_h _w 3"], ...] | None:
    """Pictures of rasters, all of one `draw`, 0..1; None where no kernel can tell."""
    if (found := drawn.pictures_of(rasters, around)) is not None:
        return found
    layers = [layer for each in around for layer in (each.front, each.back) if layer is not None]
    if not suits(*(raster.color for raster in rasters), *(layer.color for layer in layers)):
        return None
    given = zip(rasters, around, strict=True)
    return tuple(_Between.apply(r.color, r.transmittance, r.depth, each) for r, each in given)


def seen_behind(
    residual: Float[Tensor, "h w 3"], in_front: Float[Tensor, "h w"] | None
) -> Float[Tensor, "h w 4"]:
    """A picture's residual as ResidualSums take it, of what lies behind something of this transmittance."""
    shows = torch.ones_like(residual[..., :1]) if in_front is None else in_front[..., None]
    return torch.cat((residual * shows, shows), dim=-1)


@torch.no_grad()
def lacking(
    picture: Float[Tensor, "h w 3"], photo: Float[Tensor, "h w c"], in_front: Float[Tensor, "h w"] | None
) -> tuple[Float[Tensor, "h w 4"], Float[Tensor, ""]]:
    """What a picture lacks of its photo's first three channels, `seen_behind` something; and the squared
    error of a pixel, summed over channels."""
    photo, front = photo[..., :3], [] if in_front is None else [in_front]
    if suits(picture, photo, *front):
        picture, photo, *front = (value.contiguous() for value in (picture, photo, *front))
        count, behind = picture[..., 0].numel(), picture.new_empty((*picture.shape[:2], 4))
        pointers = map(address, (picture, photo, *(front or [None]), behind))
        return behind, picture.new_tensor(library().abcd_residual(count, *pointers) / max(count, 1))
    residual = photo - picture
    return seen_behind(residual, in_front), residual.square().sum(dim=-1).mean()


def _as_shown(drawn: Layer, around: Surroundings) -> tuple[Any, list[Tensor]]:
    """As the library takes it, and what has to live as long."""
    held, values = [around.background.contiguous()], list[int | None]()
    for layer in (around.front, drawn, around.back):
        own = [] if layer is None else [_evenly_spaced(layer.color), _evenly_spaced(layer.transmittance)]
        held += own
        values += [*map(address, own), *(value.stride(1) for value in own)] or [None, None, 0, 0]
    return ctypes.byref(_Shown(*values, address(held[0]))), held


def _evenly_spaced(pixels: Float[Tensor, "h w ..."]) -> Float[Tensor, "h w ..."]:
    """The same pixels, as far from each other in memory everywhere, their channels side by side."""
    down, across, *channels = pixels.stride()
    return pixels if down == across * pixels.shape[1] and channels in ([], [1]) else pixels.contiguous()
