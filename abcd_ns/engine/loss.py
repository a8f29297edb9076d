"""The photometric loss of 3DGS on a crop, weighed as a part of the full image."""

import math
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from abcd_ns.engine.kernels import Kernel

SSIM_WINDOW = 11
"""Side of SSIM's Gaussian window, pixels."""
SSIM_SIGMA = 1.5
"""Standard deviation of SSIM's Gaussian window, pixels."""
_C1, _C2 = 0.01**2, 0.03**2
_BELL = [math.exp(-((k - SSIM_WINDOW // 2) ** 2) / (2 * SSIM_SIGMA**2)) for k in range(SSIM_WINDOW)]
_TAPS = [tap / sum(_BELL) for tap in _BELL]


def _blur(image: Float[Tensor, "c h w"]) -> Float[Tensor, "c g v"]:
    """SSIM's window slid over the image, where it lies wholly inside."""
    height, width = image.shape[1] - SSIM_WINDOW + 1, image.shape[2] - SSIM_WINDOW + 1
    rows = sum(tap * image[:, :, k : k + width] for k, tap in enumerate(_TAPS))
    return sum(tap * rows[:, k : k + height] for k, tap in enumerate(_TAPS))


def _blur_transposed(image: Float[Tensor, "c g v"]) -> Float[Tensor, "c h w"]:
    return _blur(F.pad(image, [SSIM_WINDOW - 1] * 4))


def photometric_kernel(
    rendered: Float[Tensor, "3 h w"], photo: Float[Tensor, "3 h w"], weights: Float[Tensor, "2"]
) -> tuple[Float[Tensor, "2"], Float[Tensor, "3 h w"]]:
    """Sums of |difference| and of 1 - SSIM, and the gradient of `weights` . sums by `rendered`.

    SSIM as pytorch_msssim computes it (Wang et al. 2004). With blurred moments m_x, m_y, m_xx, m_yy, m_xy and
    S = A1 A2 / (B1 B2), it depends on x through m_x, m_xx and m_xy; each adds a transposed blur.
    """
    m_x, m_y = _blur(rendered), _blur(photo)
    m_xx, m_yy, m_xy = _blur(rendered * rendered), _blur(photo * photo), _blur(rendered * photo)
    a1, a2 = 2 * m_x * m_y + _C1, 2 * (m_xy - m_x * m_y) + _C2
    b1, b2 = m_x * m_x + m_y * m_y + _C1, (m_xx - m_x * m_x) + (m_yy - m_y * m_y) + _C2
    similarity = a1 * a2 / (b1 * b2)
    by_xy, by_xx = 2 * a1 / (b1 * b2), -similarity / b2
    by_x = 2 * m_y * a2 / (b1 * b2) - 2 * m_x * similarity / b1 - m_y * by_xy - 2 * m_x * by_xx
    gradient = _blur_transposed(by_x) + 2 * rendered * _blur_transposed(by_xx)
    gradient = gradient + photo * _blur_transposed(by_xy)
    difference = rendered - photo
    sums = torch.stack((difference.abs().sum(), (1 - similarity).sum()))
    return sums, weights[0] * difference.sign() - weights[1] * gradient


PHOTOMETRIC = Kernel("photometric", photometric_kernel, ("3 h w", "3 h w", "2"), smallest=SSIM_WINDOW + 1)


class _Photometric(torch.autograd.Function):
    """`weights` . sums of `photometric_kernel`, which finds the gradient in the same go."""

    @staticmethod
    def forward(
        ctx: Any, rendered: Float[Tensor, "3 h w"], photo: Float[Tensor, "3 h w"], weights: Float[Tensor, "2"]
    ) -> Float[Tensor, ""]:
        sums, gradient = PHOTOMETRIC(rendered, photo, weights)
        ctx.save_for_backward(gradient)
        return (sums * weights).sum()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Float[Tensor, ""]) -> tuple[Float[Tensor, "3 h w"], None, None]:
        return grad * ctx.saved_tensors[0], None, None


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
    height, width = rendered.shape[:2]
    if full_windows == 0 or min(height, width) < SSIM_WINDOW:
        return (1 - ssim_lambda) * (rendered - photo).abs().sum() / (3 * full_pixels)
    weights = rendered.new_tensor([(1 - ssim_lambda) / (3 * full_pixels), ssim_lambda / (3 * full_windows)])
    planes = (image.permute(2, 0, 1).contiguous() for image in (rendered, photo))
    return _Photometric.apply(*planes, weights)


def ssim_windows(height: int, width: int) -> int:
    """How many SSIM windows lie wholly inside an image; 0 where it is smaller than one."""
    return max(height - SSIM_WINDOW + 1, 0) * max(width - SSIM_WINDOW + 1, 0)


def psnr(rendered: Float[Tensor, "..."], photo: Float[Tensor, "..."]) -> Float[Tensor, ""]:
    """Peak signal-to-noise ratio in dB for values in 0..1; infinite where both are equal."""
    return -10 * torch.log10(torch.mean((rendered - photo) ** 2))
