"""What counts as ill: pure functions of Gaussians."""

import math
from collections.abc import Iterable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from abcd_ns.engine.transfer import upload
from abcd_ns.engine.types import Gaussians, View, centers_of

STAND_IN_OPACITY = -9.0
"""Logit of the opacity of a Gaussian that takes the place of one that was lost; far below MIN_ALPHA."""
LARGEST_LOG_SCALE = 40.0
"""A standard deviation of e^40; its square still is a number in float32."""
OVERSIZED_ANGLE = 0.3
"""An oversized Gaussian's standard deviation is over this share of its distance to the nearest camera: 3
sigma cover 45 degrees to either side. What is far away, sky for instance, may be large."""
HIDDEN = 1e-4
"""A block that is no larger share of any picture is hidden: rasterizers stop at so little light."""
DISTANCES_AT_ONCE = 1 << 22
"""Between Gaussians and cameras."""


def unsound(gaussians: Gaussians) -> Bool[Tensor, "n"]:
    """Which Gaussians hold a value that is no number, or a scale whose square is none."""
    bad = gaussians.scales.amax(dim=1) > LARGEST_LOG_SCALE
    for _, value in gaussians.items():
        bad = bad | ~torch.isfinite(value).flatten(1).all(dim=1)
    return bad


@torch.no_grad()
def wider_than(
    angle: float, scales: Float[Tensor, "n 3"], means: Float[Tensor, "n 3"], views: Iterable[View]
) -> tuple[Bool[Tensor, "n 3"], Float[Tensor, "n 1"]]:
    """Along which axes a standard deviation is over this share of the distance to the nearest camera, and the
    logarithm of what would not be.

    Args:
        scales: logarithms of standard deviations.
    """
    views = tuple(views)
    near = torch.tensor([[view.near] for view in views], dtype=torch.float64)
    cameras = upload(torch.cat((centers_of(views), near), dim=1).to(means.dtype), means.device)
    nearest = means.new_full((len(means),), math.inf)
    for few in cameras.split(max(DISTANCES_AT_ONCE // max(len(means), 1), 1)):
        nearest = torch.minimum(nearest, torch.maximum(_distances(means, few[:, :3]), few[:, 3]).amin(dim=1))
    allowed = (angle * nearest).log()[:, None]
    return scales > allowed, allowed


def _distances(ours: Float[Tensor, "n 3"], theirs: Float[Tensor, "m 3"]) -> Float[Tensor, "n m"]:
    """Not by a matrix product, which loses what is near."""
    if ours.device.type == "cpu":  # elsewhere this makes a block of threads for each distance
        return torch.cdist(ours, theirs, compute_mode="donot_use_mm_for_euclid_dist")
    return torch.linalg.vector_norm(ours[:, None] - theirs, dim=-1)


@torch.no_grad()
def share_of_picture(in_front: Float[Tensor, "h w"] | None, own: Float[Tensor, "h w"]) -> Float[Tensor, ""]:
    """How large a part of a picture a block can be, 0..1.

    Args:
        in_front: transmittance of what lies before the block; None for nothing.
        own: that of the block, and of what was sorted in with it.
    """
    alpha = 1 - own
    return (alpha if in_front is None else in_front * alpha).mean()


def stand_ins(sound: Gaussians, count: int) -> Gaussians:
    """`count` Gaussians amid the `sound` ones, as large as they usually are, and too faint to be drawn."""
    known = len(sound) > 0
    values = {name: value.new_zeros((count, *value.shape[1:])) for name, value in sound.items()}
    for name in ("means", "scales"):
        if known:
            values[name] += getattr(sound, name).median(dim=0).values
    values["quats"][:, 0] = 1.0
    values["opacities"] += STAND_IN_OPACITY
    return Gaussians(**values)
