"""Shedding: a Gaussian that fills less of its views than its price is taken out.

What a Gaussian weighs in a picture is the sum over pixels of alpha T, the transmittance of whatever lies
before its block included: so many pixels it fills. Drawings that train it tell for nothing (see `weighing`).
Added up over the views of its block it says what would be missing without it, as RadSplat (Niemeyer et al.,
2024) and LightGaussian (Fan et al., NeurIPS 2024) prune by the largest and by the sum of such weights when
training ends. Here they go while it goes on, at a price that rises as growth comes to its end: those that
remain take their place, and each step costs less. Nor do those grow that could not pay for two.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

WEIGHED = ("weight", "looks")
"""What is added up for each Gaussian: its weight, px, and the drawings in which it might have shown."""
LAST = 0.7
"""Share of the run after which nothing that fills anything goes, nor a block grows for being new."""
GROWS = 4.0
"""Times its price that a Gaussian fills before it is cloned or split: more than both halves must."""
PASSES = 4
"""A block that is the whole scene sheds whenever each of its views was drawn so often."""


def weigh(infos: Sequence[Mapping[str, Any]]) -> dict[str, Tensor]:
    """What drawings add to WEIGHED, after backward; each [n]. Nothing if they were drawn without weighing."""
    found = [info["weights"].grad for info in infos if "weights" in info]
    if not found or any(weights is None for weights in found):
        return {}
    weight = torch.cat(found).sum(dim=0)
    looks = torch.full_like(weight, float(sum(len(weights) for weights in found)))
    # An accelerator may have skipped a step that was no number.
    return dict(zip(WEIGHED, (weight.nan_to_num(0.0, 0.0, 0.0), looks), strict=True))


def worthless(growth: Mapping[str, Tensor], views: int, price: float) -> Bool[Tensor, "n"]:
    """Which Gaussians fill less than `price` pixels in all of their block's views together.

    Nobody is judged before as many drawings as there are views.

    Args:
        growth: with WEIGHED.
        views: that see the block.
    """
    weight, looks = (growth[name] for name in WEIGHED)
    return (looks >= views) & (weight * views <= price * looks)


def may_grow(growth: Mapping[str, Tensor], views: int, price: float) -> Bool[Tensor, "n"]:
    """Which Gaussians fill GROWS prices in all of their block's views together; those never weighed may grow.

    Args:
        growth: with WEIGHED.
        views: that see the block.
    """
    weight, looks = (growth[name] for name in WEIGHED)
    return weight * views >= GROWS * price * looks


def faded(growth: Mapping[str, Tensor], views: int) -> dict[str, Float[Tensor, "n"]]:
    """The statistics when all have been judged: what is seen from now on soon counts for more."""
    half = torch.where(growth["looks"] >= views, 0.5, 1.0)
    return {name: value * half if name in WEIGHED else value for name, value in growth.items()}


def price_at(price: float, progress: float, growth_ends: float) -> float:
    """The price at a share of the run: it rises until growth ends, for who is new has not found its place.
    Late in the run only what fills nothing at all goes, for what is missed could not be made good."""
    if progress >= LAST:
        return 0.0
    return price * min(progress / growth_ends, 1.0) if growth_ends > 0 else price
