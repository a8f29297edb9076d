"""L1 and SSIM with their gradient, by the native library or in torch."""

import math

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.kernels.native import address, library, suits

SSIM_WINDOW = 11
"""Side of SSIM's Gaussian window, pixels."""
REACH = SSIM_WINDOW - 1
"""Pixels by which the window makes an image smaller."""
SSIM_STRIDE = 2
"""Rows from one row of windows to the next. The rows between would change the gradient by half a percent."""
SSIM_SIGMA = 1.5
"""Standard deviation of SSIM's Gaussian window, pixels."""
C1, C2 = 0.01**2, 0.03**2
_BELL = [math.exp(-((k - SSIM_WINDOW // 2) ** 2) / (2 * SSIM_SIGMA**2)) for k in range(SSIM_WINDOW)]
TAPS = [tap / sum(_BELL) for tap in _BELL]


def photometric_sums(
    rendered: Float[Tensor, "h w 3"], photo: Float[Tensor, "h w 3"], weights: tuple[float, float]
) -> tuple[Float[Tensor, "2"], Float[Tensor, "h w 3"]]:
    """Sums of |difference| and of 1 - SSIM (see `dissimilarity`), and the gradient of `weights` . sums by
    `rendered`.

    Images are at least as large as the window.
    """
    if not suits(rendered, photo):
        return _in_torch(rendered, photo, weights)
    rendered, photo = rendered.contiguous(), photo.contiguous()
    (height, width, _), gradient = rendered.shape, torch.empty_like(rendered)
    sums, by_sum = torch.empty(2, dtype=torch.float64), torch.tensor(weights, dtype=torch.float32)
    pointers = map(address, (by_sum, sums, gradient))
    library().abcd_photometric(address(rendered), address(photo), height, width, *pointers)
    return sums.float(), gradient


def _in_torch(rendered: Tensor, photo: Tensor, weights: tuple[float, float]) -> tuple[Tensor, Tensor]:
    with torch.enable_grad():
        leaf = rendered.detach().requires_grad_()
        sums = torch.stack(((leaf - photo).abs().sum(), dissimilarity(leaf, photo)))
        (gradient,) = torch.autograd.grad(sums @ sums.new_tensor(weights), leaf)
    return sums.detach(), gradient


def dissimilarity(x: Float[Tensor, "h w 3"], y: Float[Tensor, "h w 3"]) -> Float[Tensor, ""]:
    """The sum of 1 - SSIM over windows that lie wholly inside, estimated from every other row of them.

    SSIM is as pytorch_msssim computes it (Wang et al. 2004): with blurred moments m_x, m_y, m_xx, m_yy and
    m_xy it is A1 A2 / (B1 B2).
    """
    moments = torch.cat((x, y, x * x, y * y, x * y), dim=2).permute(2, 0, 1)[:, None]
    taps = x.new_tensor(TAPS)
    rows = F.conv2d(moments, taps.view(1, 1, 1, -1))
    blurred = F.conv2d(rows, taps.view(1, 1, -1, 1), stride=(SSIM_STRIDE, 1))
    m_x, m_y, m_xx, m_yy, m_xy = blurred.split(3)
    a1, a2 = 2 * m_x * m_y + C1, 2 * (m_xy - m_x * m_y) + C2
    b1, b2 = m_x * m_x + m_y * m_y + C1, (m_xx - m_x * m_x) + (m_yy - m_y * m_y) + C2
    return (1 - a1 * a2 / (b1 * b2)).sum() * ((x.shape[0] - REACH) / m_x.shape[2])
