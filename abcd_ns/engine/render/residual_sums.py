"""What a drawing's residual says of each Gaussian: sums over pixels, by which growth decides."""

from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.types import Crop

SUMS = 10
"""Of a Gaussian in a picture."""


class ResidualSums:
    """For each Gaussian of a drawing the sums over pixels of w f, w r, w r x and w r y.

    There w = alpha T is its weight, r the residual by channel, f how much the pixel counts, and (x, y) the
    pixel's middle less the Gaussian's, px.

    Args:
        find: values for residuals, apart from the drawing's gradients; None where its backward pass finds
            both at once.
    """

    def __init__(self, find: Callable[[Sequence[Tensor]], Float[Tensor, "v n 10"]] | None = None) -> None:
        self.values: Float[Tensor, "v n 10"] | None = None
        """After the drawing's backward pass; None where nobody has asked."""
        self.asked: list[Tensor] | None = None
        """The residuals that the backward pass is to sum up."""
        self._find = find  # which holds on to all that was drawn

    def ask(self, residuals: Sequence[Float[Tensor, "_h _w 4"]]) -> None:
        """Call before the backward pass, with r and then f of each picture."""
        if self._find is None:
            self.asked = [residual.contiguous() for residual in residuals]
        else:
            self.values, self._find = self._find(residuals), None


def moments(residual: Float[Tensor, "h w 4"], crop: Crop) -> Float[Tensor, "h w 10"]:
    """f, r, r x and r y of each pixel, with x and y in the image."""
    r, f = residual[..., :3], residual[..., 3:]
    x = torch.arange(crop.width, device=r.device, dtype=r.dtype)[:, None] + (crop.x + 0.5)
    y = torch.arange(crop.height, device=r.device, dtype=r.dtype)[:, None, None] + (crop.y + 0.5)
    return torch.cat((f, r, r * x, r * y), dim=-1)


def about(sums: Float[Tensor, "*n 10"], middle: Float[Tensor, "*n 2"]) -> Float[Tensor, "*n 10"]:
    """Sums of `moments`, with x and y counted from the Gaussians' middles."""
    f, r, x, y = sums.split((1, 3, 3, 3), dim=-1)
    middle = torch.where(f == 0, 0.0, middle)  # gsplat gives none of who is not drawn
    return torch.cat((f, r, x - middle[..., :1] * r, y - middle[..., 1:] * r), dim=-1)
