"""L1 and SSIM with their gradient, in four fused loops.

The window of SSIM is separable: it slides along rows, then along columns. Each direction is a kernel of its
own, as a compiler that fuses both would slide along the rows anew for each of the eleven taps. Images are
taken as one long row of pixels, as loops that end with each row spend much of their time on row ends.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.kernels import Kernel

SSIM_WINDOW = 11
"""Side of SSIM's Gaussian window, pixels."""
REACH = SSIM_WINDOW - 1
"""Pixels by which the window makes an image smaller."""
SSIM_SIGMA = 1.5
"""Standard deviation of SSIM's Gaussian window, pixels."""
C1, C2 = 0.01**2, 0.03**2
_BELL = [math.exp(-((k - SSIM_WINDOW // 2) ** 2) / (2 * SSIM_SIGMA**2)) for k in range(SSIM_WINDOW)]
TAPS = [tap / sum(_BELL) for tap in _BELL]


def slide_rows(pixels: Float[Tensor, "n"]) -> tuple[Float[Tensor, "n-10"]]:
    """SSIM's window slid over all rows of images as if they were one; void across row ends."""
    count = pixels.shape[0] - REACH
    return (sum(tap * pixels[k : k + count] for k, tap in enumerate(TAPS)),)


def _slide_columns(images: Float[Tensor, "c h w"]) -> Float[Tensor, "c n"]:
    """SSIM's window slid along columns, where it lies wholly inside; the rows that remain in one."""
    width, count = images.shape[2], (images.shape[1] - REACH) * images.shape[2]
    flat = images.flatten(1)
    return sum(tap * flat[:, k * width : k * width + count] for k, tap in enumerate(TAPS))


def dissimilarity(
    rows: Float[Tensor, "15 h w"], inside: Float[Tensor, "g w"]
) -> tuple[Float[Tensor, ""], Float[Tensor, "9 g w"]]:
    """The sum of 1 - SSIM, and what SSIM changes by with m_x, m_xx and m_xy.

    SSIM as pytorch_msssim computes it (Wang et al. 2004): with blurred moments m_x, m_y, m_xx, m_yy and m_xy
    it is A1 A2 / (B1 B2).

    Args:
        rows: x, y, x^2, y^2 and x y of three channels, blurred along rows.
        inside: 1 for windows that lie within the image, 0 for those that cross a row's end.
    """
    m_x, m_y, m_xx, m_yy, m_xy = _slide_columns(rows).split(3)
    a1, a2 = 2 * m_x * m_y + C1, 2 * (m_xy - m_x * m_y) + C2
    b1, b2 = m_x * m_x + m_y * m_y + C1, (m_xx - m_x * m_x) + (m_yy - m_y * m_y) + C2
    similarity = a1 * a2 / (b1 * b2)
    by_xy, by_xx = 2 * a1 / (b1 * b2), -similarity / b2
    by_x = 2 * m_y * a2 / (b1 * b2) - 2 * m_x * similarity / b1 - m_y * by_xy - 2 * m_x * by_xx
    flat = inside.flatten()
    by_moment = torch.cat((by_x, by_xx, by_xy)) * flat
    return ((1 - similarity) * flat).sum(), by_moment.view(9, *inside.shape)


def combine(
    rows: Float[Tensor, "9 r w"],
    rendered: Float[Tensor, "3 h w"],
    photo: Float[Tensor, "3 h w"],
    weights: Float[Tensor, "2"],
) -> tuple[Float[Tensor, ""], Float[Tensor, "3 h w"]]:
    """The sum of |difference|, and the gradient of both sums, weighed, by `rendered`.

    Args:
        rows: what `dissimilarity` gives, within a margin of zeros, blurred along rows.
    """
    by_x, by_xx, by_xy = _slide_columns(rows).split(3)
    x, y = rendered.flatten(1), photo.flatten(1)
    similarity = by_x + 2 * x * by_xx + y * by_xy
    difference = x - y
    gradient = weights[0] * difference.sign() - weights[1] * similarity
    return difference.abs().sum(), gradient.view(rendered.shape)


SLIDE_ROWS = Kernel("slide-rows", slide_rows, ("n+10",))
DISSIMILARITY = Kernel("dissimilarity", dissimilarity, ("15 g+10 w", "g w"))
COMBINE = Kernel("combine", combine, ("9 h+10 w", "3 h w", "3 h w", "2"))
PHOTOMETRIC_KERNELS = (SLIDE_ROWS, DISSIMILARITY, COMBINE)


def photometric_sums(
    rendered: Float[Tensor, "3 h w"], photo: Float[Tensor, "3 h w"], weights: Float[Tensor, "2"]
) -> tuple[Float[Tensor, "2"], Float[Tensor, "3 h w"]]:
    """Sums of |difference| and of 1 - SSIM, and the gradient of `weights` . sums by `rendered`.

    Images are at least as large as the window.
    """
    _, height, width = rendered.shape
    moments = (rendered, photo, rendered * rendered, photo * photo, rendered * photo)
    (rows,) = SLIDE_ROWS(torch.cat([*map(torch.flatten, moments), rendered.new_zeros(REACH)]))
    inside = rendered.new_zeros((height - REACH, width))
    inside[:, : width - REACH] = 1.0
    unlike, by_moment = DISSIMILARITY(rows.view(15, height, width), inside)
    # The way back. Columns that were void are 0 and keep rows apart, rows of zeros keep images apart.
    spread = rendered.new_zeros(REACH + 9 * (height + REACH) * width)
    spread[REACH:].view(9, -1, width)[:, REACH:height].copy_(by_moment)
    (rows,) = SLIDE_ROWS(spread)
    difference, gradient = COMBINE(rows.view(9, -1, width), rendered, photo, weights)
    return torch.stack((difference, unlike)), gradient
