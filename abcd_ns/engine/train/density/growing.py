"""Growing: one Gaussian becomes two, side by side along one of its axes, where that is worth it.

3DGS (Kerbl et al., 2023) doubles a small one in place and puts the halves of a large one at random: either
upsets the picture. Here the two together have the optical depth, the middle and the variance of the one.

A split is worth the squared error that the two halves could remove by differing in colour. For a Gaussian and
one of its axes let s be a standard deviation along it on screen, Q the inverse covariance there, d a pixel's
offset from the middle, w = alpha T the weight in it and r = photo - picture. Halves that differ by h change
the picture by h phi, with phi = w (Q s . d). Over some views let b be the sum of phi r, by channel, and A
that of phi^2: then h = b / A removes b^2 / A of squared error.

Views are in two halves: h is found by one and tried on the other, 2 h b - h^2 A, and the other way round. So
what only some views ask for is worth less than nothing.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from gsplat.strategy import ops as gsplat_ops
from gsplat.utils import normalized_quat_to_rotmat
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from abcd_ns.engine.gaussians.param_swap import Optimizers, Params
from abcd_ns.engine.kernels.native import address, library, suits
from abcd_ns.engine.render.splat_kernels import EPS_2D
from abcd_ns.engine.train.density.pruning import BLEND_SUMS
from abcd_ns.engine.transfer import upload
from abcd_ns.engine.types import Gaussians, View

WORTH = "worth"
"""Name of the statistic, [n, 27]: b [axis, channel] and A [axis] of each half of the views, then sums over
pictures of whether it shows, of the error of a pixel and of 1."""
BY_CHANNEL, BY_AXIS, COLUMNS = 9, 3, 27
"""Columns of b, of A, and in all."""
TINY = 1e-8
"""Added to A, which may be 0."""
APART, NARROWED = 0.8, 0.6
"""Shares of the one's standard deviation along its axis: how far from its middle the two lie, and their own.
The squares add up to 1, so that variances agree."""
LEAST = 1e-6
"""Transmittance of the most opaque, whose optical depth would have no end."""


@dataclass(frozen=True)
class Judged:
    """One picture of a step, of which the residual is known."""

    view: View
    sums: Float[Tensor, "n 10"]
    """See ResidualSums, of the block's Gaussians."""
    error: Float[Tensor, ""]
    """Squared error of a pixel, summed over channels: the mean of the picture's."""
    share: float = 1.0
    """Of the pixels that might have been drawn, those that are."""


def half_of(view: int) -> int:
    """The half that a view is in, by the sequence of Thue and Morse, which is in step with no camera rig."""
    return view.bit_count() & 1


@torch.no_grad()
def add_picture(growth: dict[str, Tensor], gaussians: Gaussians, axes: int, picture: Judged) -> None:
    """Add what a picture says to WORTH, in place, which begins with zeros; Gaussians extend along `axes`."""
    view, means = picture.view, gaussians.means
    if WORTH not in growth:
        growth[WORTH] = means.new_zeros((len(means), COLUMNS))
    table, start = growth[WORTH], (BY_CHANNEL + BY_AXIS) * half_of(view.index)
    camera = view.numbers.detach().to(means.dtype)
    if suits(means, table, picture.sums):
        given = means, gaussians.scales, gaussians.quats, picture.sums, camera
        given = [each.contiguous() for each in given]  # held while their addresses are in use
        into = address(table)
        library().abcd_worth(len(table), *map(address, given), axes, picture.share, into, COLUMNS, start)
    else:
        table[:, start : start + BY_CHANNEL + BY_AXIS] += _asked(gaussians, axes, picture, camera)
    table[:, -3] += picture.sums[:, 0] > 0
    table[:, -2] += picture.error.to(means).nan_to_num(0.0, 0.0, 0.0)
    table[:, -1] += 1


def _asked(
    gaussians: Gaussians, axes: int, picture: Judged, camera: Float[Tensor, "22"]
) -> Float[Tensor, "n 12"]:
    """b and A of one picture."""
    means = gaussians.means
    turn, shift, focal = upload(camera, means.device)[:14].split((9, 3, 2))
    turn = turn.view(3, 3)
    x, y, z = (means @ turn.T + shift).T[..., None].unbind(0)
    z = z.clamp_min(picture.view.near)
    axis = normalized_quat_to_rotmat(F.normalize(gaussians.quats, dim=1)) * gaussians.scales.exp()[:, None]
    along_x, along_y, along_z = (turn @ axis).unbind(1)  # a standard deviation of each axis, [n, 3]
    right, down = (along_x - x / z * along_z) * focal[0] / z, (along_y - y / z * along_z) * focal[1] / z
    xx, xy, yy = ((p * q).sum(1, keepdim=True) for p, q in ((right, right), (right, down), (down, down)))
    xx, yy = xx + EPS_2D, yy + EPS_2D
    det = xx * yy - xy * xy
    q_x, q_y = (yy * right - xy * down) / det, (xx * down - xy * right) / det
    weight, _, r_x, r_y = picture.sums.split((1, 3, 3, 3), dim=1)
    b = q_x[..., None] * r_x[:, None] + q_y[..., None] * r_y[:, None]
    # As if nothing lay before any part of it: phi^2 integrates to this over a Gaussian of its weight.
    a = weight.square() * (q_x * right + q_y * down) / (8 * math.pi * det.sqrt())
    b[:, axes:], a[:, axes:] = 0.0, 0.0
    found = torch.cat((b.flatten(1), a), dim=1) / picture.share
    # An accelerator may have skipped a step that was no number.
    return torch.where((weight > 0) & found.isfinite().all(dim=1, keepdim=True), found, 0.0)


def share_seen(growth: Mapping[str, Tensor]) -> float:
    """The share of the Gaussians that a picture shows in the mean, by WORTH; an accelerator is waited for."""
    shows, _, pictures = growth[WORTH][:, -3:].sum(dim=0).tolist()
    return shows / max(pictures, 1.0)


def worth(
    growth: Mapping[str, Tensor], views: int, pixels: float
) -> tuple[Float[Tensor, "n"], Int64[Tensor, "n"]]:
    """Squared error that the best split of each would remove in all views, 0 where so many average pixels
    have as much; and the axis to split along."""
    *halves, _, error, pictures = growth[WORTH].split((BY_CHANNEL, BY_AXIS) * 2 + (1, 1, 1), dim=1)
    sums = [(halves[k].view(-1, BY_AXIS, 3), halves[k + 1][..., None]) for k in (0, 2)]
    gain = torch.zeros_like(sums[0][0])
    for (b, a), (others_b, others_a) in (sums, sums[::-1]):
        h = b / (a + TINY)
        gain += 2 * h * others_b - h * h * others_a
    seen = (sums[0][1] > 0) & (sums[1][1] > 0)
    best, axis = torch.where(seen, gain, 0.0).sum(dim=2).max(dim=1)
    best, per_pixel = best * (views / pictures[:, 0].clamp_min(1)), error[:, 0] / pictures[:, 0].clamp_min(1)
    return torch.where(best > pixels * per_pixel, best, 0.0), axis


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
