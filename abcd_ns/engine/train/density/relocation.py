"""The relocation of 3DGS-MCMC in torch, for devices that gsplat's CUDA operator does not serve."""

import torch
from jaxtyping import Float, Integer
from torch import Tensor


def compute_relocation(
    opacities: Float[Tensor, "n ..."],
    scales: Float[Tensor, "n 3"],
    ratios: Integer[Tensor, "n"],
    binoms: Float[Tensor, "m m"],
) -> tuple[Float[Tensor, "n ..."], Float[Tensor, "n 3"]]:
    """Opacities and scales with which `ratios` coinciding copies look like the one Gaussian they replace.

    Kheradmand et al. 2024, "3D Gaussian Splatting as Markov Chain Monte Carlo", equation 9:
    o' = 1 - (1 - o)^(1/r) and s' = s o / sum_{i=1..r} sum_{k<i} C(i-1, k) (-1)^k o'^(k+1) / sqrt(k+1).

    Args:
        opacities: after the sigmoid; [n] or [n, 1].
        scales: standard deviations.
        ratios: number of copies, clamped to 1..m.
        binoms: binoms[i, k] = C(i, k).
    """
    most = binoms.shape[0]
    copies = ratios.clamp(1, most)
    flat = opacities.reshape(-1)
    new = 1 - (1 - flat) ** (1 / copies)
    k = torch.arange(most, device=flat.device)
    sign = 1 - 2 * (k % 2)
    # binoms[:, k] summed over i - 1 = 0 .. r - 1, by a cumulative sum in float64: C(50, 25) is 1e14.
    weights = binoms.double().cumsum(dim=0)[copies.long() - 1] * sign / torch.sqrt(k + 1.0)
    denominator = (weights * new.double()[:, None] ** (k + 1)).sum(dim=1)
    factor = (flat.double() / denominator).to(scales.dtype)
    return new.reshape(opacities.shape), scales * factor[:, None]
