"""The inner kernels of the torch rasterizer, forward and backward, over one chunk of many tiles at once.

They walk K Gaussians front to back with a Python loop, which compiling unrolls and fuses. Layout:
[lane k, pixel p, tile a], tiles innermost, so that every operation runs along contiguous memory.

The state of a pixel is five planes: transmittance T, then premultiplied colour and depth. Compositing
stops for good at the fragment that would bring T to 1e-4 or below; the *sign* of T says so: a pixel whose
T is negative is finished, and |T| is its transmittance. Pixels outside the image start at T = -1.
"""

from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from abcd_ns.engine.render.splat_kernels import DEPTH, MIN_ALPHA, X, Y

MAX_ALPHA = 0.999
"""Alphas are clamped to this."""
MIN_TRANSMITTANCE = 1e-4
"""The fragment after which T would be at most this, and all behind it, are not drawn."""
STATE_PLANES = 5

Params = Float[Tensor, "c k a"]


@runtime_checkable
class Fragments(Protocol):
    """What a primitive is to these kernels: alpha at a pixel, and what follows from its gradient.

    Its parameters are rows: x and y of the mean, camera z, others of its own, opacity, red, green, blue.
    """

    opacity: int
    """Which row that is; colours come after it."""
    gradients: int
    """Sums that `sums` gives without those of absolute values."""

    def alphas(self, side: int, params: Params, origins: Float[Tensor, "2 a"]) -> tuple[Tensor, Any]:
        """min(0.999, opacity exp(-sigma)) of each fragment, [k, p, a], 0 where it is not drawn; and whatever
        `sums` wants to know again."""
        ...

    def sums(
        self, params: Params, known: Any, weights: Tensor, sigma_grads: Tensor, upstream: Tensor
    ) -> list[Tensor]:
        """What is to be summed over pixels, [k, p, a] each; the last four are dL/d(red, green, blue, depth).

        Args:
            weights: alpha T.
            sigma_grads: dL/dsigma.
            upstream: dL/d(red, green, blue, depth) of each pixel.
        """
        ...

    def table(self, drawn: Float[Tensor, "d m"]) -> Float[Tensor, "c m"]:
        """Parameters from the rows that a rasterizer projects, see Splats."""
        ...

    def to_drawn(self, drawn: Float[Tensor, "d m"], sums: Float[Tensor, "m g"]) -> Float[Tensor, "d m"]:
        """Gradients of these rows from the sums."""
        ...


def gather_params(table: Float[Tensor, "c m"], ranks: Int[Tensor, "k a"]) -> Params:
    """The parameters of the Gaussians at `ranks`."""
    return table.index_select(1, ranks.reshape(-1)).view(table.shape[0], *ranks.shape)


def offsets(params: Params, origins: Float[Tensor, "2 a"], side: int) -> tuple[Tensor, Tensor]:
    """Mean minus pixel centre: dx [k, side, 1, a]-like planes, both broadcast to [k, p, a]."""
    pixel = torch.arange(side * side, device=params.device)
    columns = ((pixel % side) + 0.5).to(params.dtype)[:, None]
    rows = (torch.div(pixel, side, rounding_mode="floor") + 0.5).to(params.dtype)[:, None]
    dx = (params[X] - origins[0])[:, None] - columns
    dy = (params[Y] - origins[1])[:, None] - rows
    return dx, dy


def _advance(T: Tensor, alpha: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """One fragment further: (next T, its weight alpha T, whether it was drawn)."""
    next_T = T * (1.0 - alpha)
    drawn = next_T > MIN_TRANSMITTANCE
    return torch.where(drawn, next_T, -T.abs()), torch.where(drawn, alpha * T, 0.0), drawn


def forward_chunk(
    fragments: Fragments,
    side: int,
    params: Params,
    origins: Float[Tensor, "2 a"],
    state: Float[Tensor, "5 p a"],
) -> tuple[Float[Tensor, "5 p a"]]:
    """Composite one chunk behind what `state` holds."""
    alphas, _ = fragments.alphas(side, params, origins)
    color = fragments.opacity + 1
    T, red, green, blue, depth = state.unbind(0)
    for k in range(params.shape[1]):
        T, weight, _ = _advance(T, alphas[k])
        red = red + weight * params[color, k]
        green = green + weight * params[color + 1, k]
        blue = blue + weight * params[color + 2, k]
        depth = depth + weight * params[DEPTH, k]
    return (torch.stack((T, red, green, blue, depth)),)


def weigh_chunk(
    fragments: Fragments,
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
    alphas, _ = fragments.alphas(side, params, origins)
    T, sums = state[0], []
    for k in range(params.shape[1]):
        T, weight, _ = _advance(T, alphas[k])
        sums.append(weight.sum(dim=0))
    return T[None], torch.stack(sums)


def median_chunk(
    fragments: Fragments,
    side: int,
    params: Params,
    origins: Float[Tensor, "2 a"],
    state: Float[Tensor, "2 p a"],
) -> Float[Tensor, "2 p a"]:
    """The depth of the last fragment that is drawn while more than half of the light passes.

    Args:
        params: rows up to the opacity.
        state: transmittance, negative where it is a half or less, and that depth so far.
    """
    alphas, _ = fragments.alphas(side, params, origins)
    T, depth = state.unbind(0)
    for k in range(params.shape[1]):
        passes = T > 0.5
        depth = torch.where(passes & (alphas[k] > 0), params[DEPTH, k], depth)
        T = torch.where(passes, T * (1.0 - alphas[k]), T)
    return torch.stack((torch.where(T > 0.5, T, -T.abs()), depth))


def backward_chunk(
    fragments: Fragments,
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
    alphas, known = fragments.alphas(side, params, origins)
    color = fragments.opacity + 1
    T, total = state[0], upstream[4]
    done = (state[1:] * upstream[:4]).sum(dim=0)
    weights, sigma_grads = [], []
    for k in range(params.shape[1]):
        alpha = alphas[k]
        value = (
            upstream[0] * params[color, k]
            + upstream[1] * params[color + 1, k]
            + upstream[2] * params[color + 2, k]
            + upstream[3] * params[DEPTH, k]
        )
        next_T, weight, drawn = _advance(T, alpha)
        done = done + weight * value
        alpha_grad = T * value - (total - done) / (1.0 - alpha)
        # No gradient through the clamp, as in gsplat.
        sigma_grads.append(torch.where(drawn & (alpha < MAX_ALPHA), -alpha * alpha_grad, 0.0))
        weights.append(weight)
        T = next_T
    sums = fragments.sums(params, known, torch.stack(weights), torch.stack(sigma_grads), upstream)
    return (torch.stack([plane.sum(dim=1) for plane in sums]),)


def alpha_of(
    opacity: Float[Tensor, "k a"], sigma: Float[Tensor, "k p a"], drawn: Tensor
) -> Float[Tensor, "k p a"]:
    """min(0.999, opacity exp(-sigma)) where it is drawn, else 0."""
    alphas = (opacity[:, None] * torch.exp(-sigma)).clamp_max(MAX_ALPHA)
    return torch.where(drawn & (alphas >= MIN_ALPHA), alphas, 0.0)
