"""Growing: one Gaussian becomes two, side by side along one of its axes.

3DGS (Kerbl et al., 2023) doubles a small one in place and puts the halves of a large one at random: either
upsets the picture. Here the two together have the optical depth, the middle and the variance of the one.
"""

from collections.abc import Mapping

import torch
import torch.nn.functional as F
from gsplat.strategy import ops as gsplat_ops
from gsplat.utils import normalized_quat_to_rotmat
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from abcd_ns.engine.gaussians.param_swap import Optimizers, Params
from abcd_ns.engine.train.density.pruning import BLEND_SUMS

APART, NARROWED = 0.8, 0.6
"""Shares of the one's standard deviation along its axis: how far from its middle the two lie, and their own.
The squares add up to 1, so that variances agree."""
LEAST = 1e-6
"""Transmittance of the most opaque, whose optical depth would have no end."""


def chosen(wanted: Float[Tensor, "n"], room: int) -> Bool[Tensor, "n"]:
    """Which are to become two: all above 0 or, as far as there is room, the largest."""
    which = wanted > 0
    if int(which.sum()) <= room:
        return which
    most = torch.zeros_like(which)
    most[wanted.topk(max(room, 0)).indices] = True
    return most & which


@torch.no_grad()
def split_gaussians(
    params: Params,
    optimizers: Optimizers,
    growth: Mapping[str, Tensor],
    which: Bool[Tensor, "n"],
    axis: Int64[Tensor, "n"],
) -> dict[str, Tensor]:
    """Make two of each, which lie along its axis. The others come first, in their order, then one half of
    each, then the other; their moments begin anew.

    Returns:
        The statistics afterwards: both parts inherit them, and half of the weight.
    """
    found, rows = dict(growth), torch.where(which)[0]  # a device is waited for once
    if not len(rows):
        return found
    means, opacities = params["means"][rows], torch.sigmoid(params["opacities"][rows])
    scales = torch.exp(params["scales"][rows])
    axis = axis[rows][:, None]
    along = torch.zeros_like(scales).scatter_(1, axis, scales.gather(1, axis))
    turned = normalized_quat_to_rotmat(F.normalize(params["quats"][rows], dim=1))
    offset = APART * torch.einsum("nij,nj->ni", turned, along)
    narrow = scales.scatter(1, axis, NARROWED * scales.gather(1, axis))
    # Its own halves, drawn at random, are overwritten: the rows of parameters, moments and statistics stay.
    gsplat_ops.split(params, optimizers, found, which)
    both = slice(-2 * len(rows), None)
    params["means"][both] = torch.cat((means + offset, means - offset))
    params["scales"][both] = narrow.log().repeat(2, 1)
    # Transmittances multiply, so that optical depths, -log(1 - opacity), add up: 2 NARROWED of each's in all.
    transmits = (1 - opacities).clamp_min(LEAST) ** (1 / (2 * NARROWED))
    params["opacities"][both] = torch.logit(1 - transmits).repeat(2, 1)
    weight, _ = BLEND_SUMS
    if weight in found:
        found[weight][both] /= 2
    return found
