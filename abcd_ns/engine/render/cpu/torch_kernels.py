"""The inner kernels of the torch rasterizer, forward and backward, over one chunk of many tiles at once.

They walk K Gaussians front to back with a Python loop, which compiling unrolls and fuses. Layout:
[lane k, pixel p, tile a], tiles innermost, so that every operation runs along contiguous memory.

The state of a pixel is five planes: transmittance T, then premultiplied colour and depth. Compositing
stops for good at the fragment that would bring T to 1e-4 or below; the *sign* of T says so: a pixel whose
T is negative is finished, and |T| is its transmittance. Pixels outside the image start at T = -1.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from abcd_ns.engine.render.splat_kernels import (
    BLUE,
    CONIC_XX,
    CONIC_XY,
    CONIC_YY,
    DEPTH,
    GREEN,
    MIN_ALPHA,
    OPACITY,
    RED,
    X,
    Y,
)

MAX_ALPHA = 0.999
"""Alphas are clamped to this."""
MIN_TRANSMITTANCE = 1e-4
"""The fragment after which T would be at most this, and all behind it, are not drawn."""
STATE_PLANES = 5

MOMENTS = 6
GRADIENTS = MOMENTS + 4
"""What the backward kernel sums per Gaussian and tile: with s = dL/dsigma and d = mean - pixel, the moments
s, s dx, s dy, s dx^2, s dx dy, s dy^2; then dL/d(red, green, blue, depth); then |dL/d(x, y)|."""
ALL_GRADIENTS = GRADIENTS + 2

Params = Float[Tensor, "c k a"]


def gather_params(table: Float[Tensor, "c m"], ranks: Int[Tensor, "k a"]) -> Params:
    """The parameters of the Gaussians at `ranks`."""
    return table.index_select(1, ranks.reshape(-1)).view(table.shape[0], *ranks.shape)


def _offsets(params: Params, origins: Float[Tensor, "2 a"], side: int) -> tuple[Tensor, Tensor]:
    """Mean minus pixel centre: dx [k, side, 1, a]-like planes, both broadcast to [k, p, a]."""
    pixel = torch.arange(side * side, device=params.device)
    columns = ((pixel % side) + 0.5).to(params.dtype)[:, None]
    rows = (torch.div(pixel, side, rounding_mode="floor") + 0.5).to(params.dtype)[:, None]
    dx = (params[X] - origins[0])[:, None] - columns
    dy = (params[Y] - origins[1])[:, None] - rows
    return dx, dy


def _alphas(params: Params, dx: Tensor, dy: Tensor) -> Float[Tensor, "k p a"]:
    """min(0.999, opacity exp(-sigma)) of each fragment, 0 where it is not drawn."""
    half_xx, xy, half_yy = 0.5 * params[CONIC_XX], params[CONIC_XY], 0.5 * params[CONIC_YY]
    sigma = dx * (half_xx[:, None] * dx + xy[:, None] * dy) + half_yy[:, None] * dy * dy
    alphas = (params[OPACITY][:, None] * torch.exp(-sigma)).clamp_max(MAX_ALPHA)
    return torch.where((sigma >= 0) & (alphas >= MIN_ALPHA), alphas, 0.0)


def _advance(T: Tensor, alpha: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """One fragment further: (next T, its weight alpha T, whether it was drawn)."""
    next_T = T * (1.0 - alpha)
    drawn = next_T > MIN_TRANSMITTANCE
    return torch.where(drawn, next_T, -T.abs()), torch.where(drawn, alpha * T, 0.0), drawn


def forward_chunk(
    side: int,
    params: Params,
    origins: Float[Tensor, "2 a"],
    state: Float[Tensor, "5 p a"],
) -> tuple[Float[Tensor, "5 p a"]]:
    """Composite one chunk behind what `state` holds."""
    alphas = _alphas(params, *_offsets(params, origins, side))
    T, red, green, blue, depth = state.unbind(0)
    for k in range(params.shape[1]):
        T, weight, _ = _advance(T, alphas[k])
        red = red + weight * params[RED, k]
        green = green + weight * params[GREEN, k]
        blue = blue + weight * params[BLUE, k]
        depth = depth + weight * params[DEPTH, k]
    return (torch.stack((T, red, green, blue, depth)),)


def weigh_chunk(
    side: int,
    params: Params,
    origins: Float[Tensor, "2 a"],
    state: Float[Tensor, "1 p a"],
) -> tuple[Float[Tensor, "1 p a"], Float[Tensor, "k a"]]:
    """`forward_chunk` for those who ask for the weights alone, summed over each tile's pixels.

    Args:
        params: rows up to the opacity.
        state: transmittance.
    """
    alphas = _alphas(params, *_offsets(params, origins, side))
    T, sums = state[0], []
    for k in range(params.shape[1]):
        T, weight, _ = _advance(T, alphas[k])
        sums.append(weight.sum(dim=0))
    return T[None], torch.stack(sums)


def backward_chunk(
    side: int,
    params: Params,
    origins: Float[Tensor, "2 a"],
    state: Float[Tensor, "5 p a"],
    upstream: Float[Tensor, "5 p a"],
) -> tuple[Float[Tensor, "g k a"]]:
    """Gradients of one chunk's Gaussians, summed over each tile's pixels.

    With e_k = dL/dC . (c_k, z_k), w_k = alpha_k T_k and total = sum of all w_k e_k + T_final dL/dT:

        dL/dalpha_k = T_k e_k - (total - sum of w_j e_j for j <= k) / (1 - alpha_k)

    so that front to back serves as well as back to front, and a chunk needs only the state it began with.

    Args:
        state: as it was before the chunk.
        upstream: dL/d(red, green, blue, depth), then `total`.
    """
    dx, dy = _offsets(params, origins, side)
    alphas = _alphas(params, dx, dy)
    T, total = state[0], upstream[4]
    done = (state[1:] * upstream[:4]).sum(dim=0)
    weights, sigma_grads = [], []
    for k in range(params.shape[1]):
        alpha = alphas[k]
        value = (
            upstream[0] * params[RED, k]
            + upstream[1] * params[GREEN, k]
            + upstream[2] * params[BLUE, k]
            + upstream[3] * params[DEPTH, k]
        )
        next_T, weight, drawn = _advance(T, alpha)
        done = done + weight * value
        alpha_grad = T * value - (total - done) / (1.0 - alpha)
        # No gradient through the clamp, as in gsplat.
        sigma_grads.append(torch.where(drawn & (alpha < MAX_ALPHA), -alpha * alpha_grad, 0.0))
        weights.append(weight)
        T = next_T
    sums = _sum_pixels(params, dx, dy, torch.stack(weights), torch.stack(sigma_grads), upstream)
    return (sums,)


def _sum_pixels(
    params: Params,
    dx: Tensor,
    dy: Tensor,
    weights: Tensor,
    sigma_grads: Tensor,
    upstream: Tensor,
) -> Float[Tensor, "g k a"]:
    s_dx, s_dy = sigma_grads * dx, sigma_grads * dy
    planes = [sigma_grads, s_dx, s_dy, s_dx * dx, s_dx * dy, s_dy * dy]
    planes += [weights * upstream[channel] for channel in range(4)]
    xx, xy, yy = params[CONIC_XX][:, None], params[CONIC_XY][:, None], params[CONIC_YY][:, None]
    planes += [(xx * s_dx + xy * s_dy).abs(), (xy * s_dx + yy * s_dy).abs()]
    return torch.stack([plane.sum(dim=1) for plane in planes])
