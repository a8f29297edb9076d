"""L1 and SSIM with their gradient on CUDA, in four Triton kernels.

As in `engine/kernels/photometric.py`: the window slides along rows, then along columns, and back the same
way. The pictures' moments stay in the GPU's cache meanwhile.
"""

import functools

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.kernels.photometric import C1, C2, REACH, SSIM_STRIDE, SSIM_WINDOW, TAPS

BLOCK = 256
SIZES = ("height", "lines", "width")
"""Arguments for whose values no kernel is compiled anew."""


@triton.jit(do_not_specialize=SIZES)
def _moments_along_rows(
    x_ptr, y_ptr, taps_ptr, out_ptr, sum_ptr, height, width, WINDOW: tl.constexpr, BLOCK: tl.constexpr
):
    """[3 h w-10] of x, y, x^2, y^2 and x y each, blurred along rows; pictures are [h w 3]. The sum, to which
    the kernels after it add, is set to 0."""
    tl.store(sum_ptr, 0.0, mask=tl.program_id(0) == 0)
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    columns = width - WINDOW + 1
    count = 3 * height * columns
    mask = at < count
    channel, row, column = at // (height * columns), at // columns % height, at % columns
    source = (row * width + column) * 3 + channel
    m_x, m_y = tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32)
    m_xx, m_yy = tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32)
    m_xy = tl.zeros((BLOCK,), tl.float32)
    for k in range(WINDOW):
        tap = tl.load(taps_ptr + k)
        x = tl.load(x_ptr + source + 3 * k, mask=mask, other=0.0)
        y = tl.load(y_ptr + source + 3 * k, mask=mask, other=0.0)
        m_x += tap * x
        m_y += tap * y
        m_xx += tap * x * x
        m_yy += tap * y * y
        m_xy += tap * x * y
    tl.store(out_ptr + at, m_x, mask=mask)
    tl.store(out_ptr + count + at, m_y, mask=mask)
    tl.store(out_ptr + 2 * count + at, m_xx, mask=mask)
    tl.store(out_ptr + 3 * count + at, m_yy, mask=mask)
    tl.store(out_ptr + 4 * count + at, m_xy, mask=mask)


@triton.jit(do_not_specialize=SIZES)
def _dissimilarity_along_columns(
    rows_ptr, taps_ptr, by_ptr, sum_ptr, scale, height, lines, width,
    C1: tl.constexpr, C2: tl.constexpr, STRIDE: tl.constexpr, WINDOW: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """[3 lines w-10] of what SSIM changes by with m_x, m_xx and m_xy each; `scale` (1 - SSIM) to the sum."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    columns = width - WINDOW + 1
    count, above = 3 * lines * columns, 3 * height * columns
    mask = at < count
    channel, row, column = at // (lines * columns), at // columns % lines, at % columns
    source = (channel * height + STRIDE * row) * columns + column
    m_x, m_y = tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32)
    m_xx, m_yy = tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32)
    m_xy = tl.zeros((BLOCK,), tl.float32)
    for k in range(WINDOW):
        tap, here = tl.load(taps_ptr + k), rows_ptr + source + k * columns
        m_x += tap * tl.load(here, mask=mask, other=0.0)
        m_y += tap * tl.load(here + above, mask=mask, other=0.0)
        m_xx += tap * tl.load(here + 2 * above, mask=mask, other=0.0)
        m_yy += tap * tl.load(here + 3 * above, mask=mask, other=0.0)
        m_xy += tap * tl.load(here + 4 * above, mask=mask, other=0.0)
    a1, a2 = 2 * m_x * m_y + C1, 2 * (m_xy - m_x * m_y) + C2
    b1, b2 = m_x * m_x + m_y * m_y + C1, (m_xx - m_x * m_x) + (m_yy - m_y * m_y) + C2
    similarity = a1 * a2 / (b1 * b2)
    by_xy, by_xx = 2 * a1 / (b1 * b2), -similarity / b2
    by_x = 2 * m_y * a2 / (b1 * b2) - 2 * m_x * similarity / b1 - m_y * by_xy - 2 * m_x * by_xx
    tl.store(by_ptr + at, by_x, mask=mask)
    tl.store(by_ptr + count + at, by_xx, mask=mask)
    tl.store(by_ptr + 2 * count + at, by_xy, mask=mask)
    tl.atomic_add(sum_ptr, scale * tl.sum(tl.where(mask, 1 - similarity, 0.0)))


@triton.jit(do_not_specialize=SIZES)
def _back_along_rows(by_ptr, taps_ptr, out_ptr, lines, width, WINDOW: tl.constexpr, BLOCK: tl.constexpr):
    """[9 lines w]: of each column, what the windows that hold it say."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    columns = width - WINDOW + 1
    mask = at < 9 * lines * width
    line, column = at // width, at % width
    found = tl.zeros((BLOCK,), tl.float32)
    for k in range(WINDOW):
        window = column - k
        inside = mask & (window >= 0) & (window < columns)
        found += tl.load(taps_ptr + k) * tl.load(by_ptr + line * columns + window, mask=inside, other=0.0)
    tl.store(out_ptr + at, found, mask=mask)


@triton.jit(do_not_specialize=SIZES)
def _gradient_along_columns(
    x_ptr, y_ptr, rows_ptr, taps_ptr, gradient_ptr, sum_ptr, by_pixel, by_window, height, lines, width,
    STRIDE: tl.constexpr, WINDOW: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """[h w 3]: the gradient of the loss by x; `by_pixel` |x - y| to the sum."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask, above = at < 3 * height * width, 3 * lines * width
    row, column, channel = at // (3 * width), at // 3 % width, at % 3
    by_x = tl.zeros((BLOCK,), tl.float32)
    by_xx = tl.zeros((BLOCK,), tl.float32)
    by_xy = tl.zeros((BLOCK,), tl.float32)
    for k in range(WINDOW):
        window = (row - k) // STRIDE
        inside = mask & (row >= k) & ((row - k) % STRIDE == 0) & (window < lines)
        tap, here = tl.load(taps_ptr + k), rows_ptr + (channel * lines + window) * width + column
        by_x += tap * tl.load(here, mask=inside, other=0.0)
        by_xx += tap * tl.load(here + above, mask=inside, other=0.0)
        by_xy += tap * tl.load(here + 2 * above, mask=inside, other=0.0)
    x = tl.load(x_ptr + at, mask=mask, other=0.0)
    y = tl.load(y_ptr + at, mask=mask, other=0.0)
    difference = x - y
    sign = tl.where(difference > 0, 1.0, 0.0) - tl.where(difference < 0, 1.0, 0.0)
    gradient = by_pixel * sign - by_window * (by_x + 2 * x * by_xx + y * by_xy)
    tl.store(gradient_ptr + at, gradient, mask=mask)
    tl.atomic_add(sum_ptr, by_pixel * tl.sum(tl.abs(difference)))


@functools.cache
def _taps(device: torch.device) -> Float[Tensor, "11"]:
    with torch.inference_mode(False):  # they outlive this call
        return torch.tensor(TAPS, device=device)


def photometric(
    rendered: Float[Tensor, "h w 3"], photo: Float[Tensor, "h w 3"], by_pixel: float, by_window: float
) -> tuple[Float[Tensor, ""], Float[Tensor, "h w 3"]]:
    """`by_pixel` times the sum of |difference| and `by_window` times that of 1 - SSIM, and the gradient of it
    all by `rendered`.

    Images are float32, on the device, and at least as large as the window.
    """
    height, width = rendered.shape[:2]
    rendered, photo, taps = rendered.contiguous(), photo.contiguous(), _taps(rendered.device)
    columns, windows = width - REACH, height - REACH
    lines = triton.cdiv(windows, SSIM_STRIDE)
    by_window *= windows / lines
    loss, gradient = rendered.new_empty(()), torch.empty_like(rendered)
    sizes = (5, 3, height, columns), (9, lines, columns), (9, lines, width)
    moments, by_moment, rows = map(rendered.new_empty, sizes)
    options = {"WINDOW": SSIM_WINDOW, "BLOCK": BLOCK}
    strided = options | {"STRIDE": SSIM_STRIDE}

    def over(count: int) -> tuple[int]:
        return (triton.cdiv(count, BLOCK),)

    pictures = rendered, photo
    _moments_along_rows[over(moments[0].numel())](*pictures, taps, moments, loss, height, width, **options)
    _dissimilarity_along_columns[over(3 * lines * columns)](
        moments, taps, by_moment, loss, by_window, height, lines, width, C1=C1, C2=C2, **strided
    )
    _back_along_rows[over(rows.numel())](by_moment, taps, rows, lines, width, **options)
    _gradient_along_columns[over(gradient.numel())](
        *pictures, rows, taps, gradient, loss, by_pixel, by_window, height, lines, width, **strided
    )
    return loss, gradient
