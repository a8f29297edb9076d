"""The photometric loss of 3DGS on a crop, weighed as a part of the full image."""

import torch
from jaxtyping import Float
from pytorch_msssim import ssim
from torch import Tensor

SSIM_WINDOW = 11
"""Side of SSIM's Gaussian window, pixels."""


def photometric_loss(
    rendered: Float[Tensor, "h w 3"],
    photo: Float[Tensor, "h w 3"],
    *,
    full_pixels: int,
    full_windows: int,
    ssim_lambda: float = 0.2,
) -> Float[Tensor, ""]:
    """(1 - lambda) L1 + lambda (1 - SSIM), summed over the crop and divided by the full image's counts.

    Kerbl et al. 2023, equation 7. Dividing by the full image's number of pixels (and of SSIM windows that
    lie wholly inside the image) makes a crop's loss the full image's less what lies outside the crop, so
    gradients, and densification thresholds with them, mean the same at every crop size.

    Args:
        full_pixels: H W of the full image.
        full_windows: (H - 10)(W - 10) of the full image, or 0 where it is too small for one window.
    """
    l1 = (rendered - photo).abs().sum() / (3 * full_pixels)
    height, width = rendered.shape[:2]
    windows = (height - SSIM_WINDOW + 1) * (width - SSIM_WINDOW + 1)
    if full_windows == 0 or min(height, width) < SSIM_WINDOW:
        return (1 - ssim_lambda) * l1
    a, b = (image.permute(2, 0, 1)[None] for image in (rendered, photo))
    dissimilarity = 1 - ssim(a, b, data_range=1.0, win_size=SSIM_WINDOW, size_average=True)
    return (1 - ssim_lambda) * l1 + ssim_lambda * dissimilarity * (windows / full_windows)


def ssim_windows(height: int, width: int) -> int:
    """How many SSIM windows lie wholly inside an image; 0 where it is smaller than one."""
    return max(height - SSIM_WINDOW + 1, 0) * max(width - SSIM_WINDOW + 1, 0)


def psnr(rendered: Float[Tensor, "..."], photo: Float[Tensor, "..."]) -> Float[Tensor, ""]:
    """Peak signal-to-noise ratio in dB for values in 0..1; infinite where both are equal."""
    return -10 * torch.log10(torch.mean((rendered - photo) ** 2))
