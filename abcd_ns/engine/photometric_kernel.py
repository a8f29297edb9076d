"""L1 and SSIM with their gradient in one fused loop."""

import math

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

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
