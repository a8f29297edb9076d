"""The photometric loss of 3DGS on a crop, weighed as a part of the full image."""

import math
from collections.abc import Sequence
from typing import Any, Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from abcd_ns.engine.kernels.photometric import SSIM_WINDOW, photometric_sums
from abcd_ns.engine.render.cuda import fused


class _Photometric(torch.autograd.Function):
    """The weighed sum of both losses, which finds its gradient in the same go."""

    @staticmethod
    def forward(ctx: Any, rendered: Tensor, photo: Tensor, by_pixel: float, by_window: float) -> Tensor:
        found = fused.photometric(rendered, photo, by_pixel, by_window)
        if found is None:
            sums, gradient = photometric_sums(rendered, photo, (by_pixel, by_window))
            found = by_pixel * sums[0] + by_window * sums[1], gradient
        loss, gradient = found
        ctx.save_for_backward(gradient)
        return loss

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Float[Tensor, ""]) -> tuple[Float[Tensor, "h w 3"] | None, ...]:
        return grad * ctx.saved_tensors[0], None, None, None


def photometric_loss(
    rendered: Float[Tensor, "h w 3"],
    photo: Float[Tensor, "h w 3"],
    *,
    full_pixels: int,
    full_windows: int,
    ssim_lambda: float = 0.2,
    pixel_loss: Literal["l1", "l2"] = "l1",
) -> Float[Tensor, ""]:
    """(1 - lambda) L1 + lambda (1 - SSIM), summed over the crop and divided by the full image's counts.

    Kerbl et al. 2023, equation 7. Dividing by the full image's number of pixels (and of SSIM windows that
    lie wholly inside the image) makes a crop's loss the full image's less what lies outside the crop, so
    gradients, and densification thresholds with them, mean the same at every crop size.

    Args:
        full_pixels: H W of the full image.
        full_windows: (H - 10)(W - 10) of the full image, or 0 where it is too small for one window.
        pixel_loss: l2 takes the squared difference in L1's place.
    """
    height, width = rendered.shape[:2]
    by_pixel = (1 - ssim_lambda) / (3 * full_pixels)
    has_windows = ssim_lambda > 0 and full_windows > 0 and min(height, width) >= SSIM_WINDOW
    by_window = ssim_lambda / (3 * full_windows) if has_windows else 0.0
    if has_windows and pixel_loss == "l1":
        return _Photometric.apply(rendered, photo, by_pixel, by_window)
    difference = rendered - photo
    loss = by_pixel * (difference.abs() if pixel_loss == "l1" else difference.square()).sum()
    return loss + _Photometric.apply(rendered, photo, 0.0, by_window) if has_windows else loss


def warm_up(device: torch.device | str) -> None:
    """Do now, before a clock runs, what the first loss on an accelerator would do: compile."""
    if torch.device(device).type != "cpu":
        picture = torch.zeros(2 * SSIM_WINDOW, 3 * SSIM_WINDOW, 3, device=device, requires_grad=True)
        options = {"full_pixels": 6 * SSIM_WINDOW**2, "full_windows": ssim_windows(*picture.shape[:2])}
        photometric_loss(picture, torch.ones_like(picture), **options).backward()


def ssim_windows(height: int, width: int) -> int:
    """How many SSIM windows lie wholly inside an image; 0 where it is smaller than one."""
    return max(height - SSIM_WINDOW + 1, 0) * max(width - SSIM_WINDOW + 1, 0)


def psnr(rendered: Float[Tensor, "..."], photo: Float[Tensor, "..."]) -> Float[Tensor, ""]:
    """Peak signal-to-noise ratio in dB for values in 0..1; infinite where both are equal."""
    return -10 * torch.log10(torch.mean((rendered - photo) ** 2))


def decibels(error: float) -> float:
    """The PSNR of a mean squared error; infinite for 0."""
    return math.inf if error == 0 else -10 * math.log10(error)


@torch.no_grad()
def squared_errors(
    rendered: Sequence[Float[Tensor, "..."]], photos: Sequence[Float[Tensor, "..."]]
) -> list[Float[Tensor, ""]]:
    """The mean squared error of each pair; see `decibels`."""
    return [F.mse_loss(a, b) for a, b in zip(rendered, photos, strict=True)]
