"""Dropout: a step leaves out some Gaussians, so that others learn to stand in for them.

Few photos, used often, are learned by heart: Gaussians that fit a single photo may lie anywhere. As in
DropGaussian (Park et al., CVPR 2025) more are left out as training goes on; here also, the fewer the photos.
"""

import random
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.render.splat_kernels import MAX_ALPHA
from abcd_ns.engine.types import Gaussians

ENOUGH_VIEWS, USED_OFTEN = 16, 100
"""With so many views nothing is left out; until each was used so often, less."""
MASK = 2**32 - 1
"""The low 32 bits of an integer."""
LEFT_OUT = -20.0
"""Logit of the opacity of what is left out; far below MIN_ALPHA."""


def dropout_at(share: float, views: int, uses: float, most: float) -> float:
    """The share of Gaussians that a step leaves out, at a share of a run, on so many views used so often.

    Args:
        most: what it nears at the end of a run, as the views become few.
    """
    return most * share * max(1 - views / ENOUGH_VIEWS, 0.0) * min(uses / USED_OFTEN, 1.0)


def thinned(gaussians: Gaussians, rate: float, seed: str) -> Gaussians:
    """The same, of which this share, by chance, is not drawn, and the others are as much more opaque."""
    if rate <= 0:
        return gaussians
    opacities = torch.sigmoid(gaussians.opacities) / (1 - rate)
    kept = _by_chance(len(opacities), seed, opacities.device)[:, None] >= rate
    logits = torch.logit(opacities.clamp(max=MAX_ALPHA))
    return replace(gaussians, opacities=torch.where(kept, logits, LEFT_OUT))


def _by_chance(count: int, seed: str, device: torch.device) -> Float[Tensor, "n"]:
    """Numbers from 0 to 1, the same on every device: lowbias32 (Wellons 2018) of consecutive integers."""
    bits = (torch.arange(count, device=device) + random.Random(seed).getrandbits(32)) & MASK
    for shift, factor in ((16, 0x7FEB352D), (15, 0x846CA68B)):
        bits = ((bits ^ (bits >> shift)) * factor) & MASK
    return (bits ^ (bits >> 16)) / 2.0**32
