"""What Gaussians weigh in the pictures of a step: the rasterizer adds it up on its way back, for nothing."""

from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from abcd_ns.engine.render import Raster


class _Weigh(torch.autograd.Function):
    """The colour as it is; whatever the loss, the depth's gradient is what a pixel counts for."""

    @staticmethod
    def forward(ctx: Any, color: Tensor, depth: Tensor, counts: Tensor) -> Tensor:  # noqa: ARG004
        ctx.save_for_backward(counts)
        return color.view_as(color)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, None]:
        return grad, ctx.saved_tensors[0], None


def weighed(raster: Raster, in_front: Float[Tensor, "h w"] | None, share: float) -> Raster:
    """The same drawing; backward leaves what each Gaussian weighs in its picture in `info["weights"].grad`.

    Args:
        raster: drawn with `weigh`.
        in_front: transmittance of what lies before it; None for nothing.
        share: of the pixels that might have been drawn, those that are.
    """
    counts = torch.ones_like(raster.depth) if in_front is None else in_front.to(raster.depth)
    return replace(raster, color=_Weigh.apply(raster.color, raster.depth, counts.detach() / share))
