"""Degrees: a Gaussian has no more spherical harmonics than show in its views.

45 of its 59 numbers say how its colour changes with the direction that it is seen from. Cameras see it from
few directions, in which fewer harmonics tell nearly as much. What their lack changes in the pictures is the
Gaussian's weight, known from pruning, times the mean square, over its views, by which its colour changes once
the lower harmonics are fitted to the higher ones. The degree is taken for which this and the cost of the
numbers are least together; those above do not come back.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from abcd_ns.engine.gaussians.block_state import MOMENTS
from abcd_ns.engine.gaussians.param_swap import Optimizers, Params, active_gaussians
from abcd_ns.engine.gaussians.spherical_harmonics import SH_C0, sh_basis_rows, up_to_degree
from abcd_ns.engine.train.density.pruning import contributions, have_contributions
from abcd_ns.engine.train.schedule import evenly
from abcd_ns.engine.transfer import upload
from abcd_ns.engine.types import Gaussians, View

GONE = "gone"
"""Among a block's statistics: by how many degrees a Gaussian's harmonics end below the highest."""
START, LATE_START = 0.5, 0.9
"""Share of the run from which on degrees go: trained by then, also where they come after growth."""
NUMBER_COST = 1e-3
"""What a coefficient, of one channel, must change in the pictures: pixels times a colour's square, 0..1."""
MOST_VIEWS = 64
"""As many of a block's views tell from where a Gaussian is seen."""
RIDGE = 1e-3 / (4 * torch.pi)
"""Added to the fit: a share of the mean square of a harmonic, so that what no view tells stays as it is."""
REACH = 3.0
"""Standard deviations up to which a Gaussian shows, about."""
AT_ONCE, OF_EACH = 1 << 22, 32
"""Numbers of a tensor where Gaussians are fitted part by part: so many, or so many for each Gaussian where
that is more, which is half of what gradients take."""


class Lowered(NamedTuple):
    """What Gaussians become."""

    features_dc: Float[Tensor, "n 3"]
    features_rest: Float[Tensor, "n k 3"]
    gone: Float[Tensor, "n"]
    """Degrees that are gone, those before included."""


def are_gone(
    gone: Float[Tensor, "n"], features_rest: Float[Tensor, "n k 3"], highest: int
) -> Bool[Tensor, "n k 1"]:
    """Which coefficients are, where the scene has this degree; `features_rest` may have a lower one."""
    return ~up_to_degree(highest - gone, features_rest.shape[1])[..., None]


@torch.no_grad()
def lower(
    params: Params, optimizers: Optimizers, growth: dict[str, Tensor], views: Sequence[View], highest: int
) -> dict[str, Tensor]:
    """Let harmonics of the active block go that do not pay, see `lowered`; gives its statistics from then."""
    if not have_contributions(growth):
        return growth
    dc, rest = params["features_dc"], params["features_rest"]
    found = lowered(active_gaussians(params).detach(), growth, views, highest)
    dc.copy_(found.features_dc)
    rest.copy_(found.features_rest)
    adam, gone = optimizers["features_rest"].state[rest], are_gone(found.gone, rest, highest)
    for moment in MOMENTS:
        adam[moment].masked_fill_(gone, 0.0)
    return {**growth, GONE: found.gone}


def lowered(
    gaussians: Gaussians, growth: Mapping[str, Tensor], views: Sequence[View], highest: int
) -> Lowered:
    """Gaussians with the degrees that pay, by the block's BLEND_SUMS and views; `highest` is the scene's
    degree. None is judged that was not drawn in all views yet."""
    weight = contributions(growth)
    gone = growth.get(GONE, torch.zeros_like(weight))
    chosen = evenly(views, MOST_VIEWS)
    numbers = torch.stack([view.numbers for view in chosen]).to(gaussians.means.dtype)
    cameras = upload(numbers, gaussians.means.device)
    coefficients = gaussians.features_rest.shape[1] + 1
    room = max(AT_ONCE, OF_EACH * len(gaussians))
    step = max(room // (coefficients * max(len(chosen), coefficients)), 1)
    parts = [slice(start, start + step) for start in range(0, max(len(gaussians), 1), step)]
    found = [_lowered(gaussians[rows], weight[rows], gone[rows], cameras, highest) for rows in parts]
    return Lowered(*(torch.cat(values) for values in zip(*found, strict=True)))


def _lowered(
    gaussians: Gaussians,
    weight: Float[Tensor, "n"],
    gone: Float[Tensor, "n"],
    cameras: Float[Tensor, "v 22"],
    highest: int,
) -> Lowered:
    """As `lowered`, at once; a weight, pixels in all views, is NaN for one that is not judged."""
    values = torch.cat((gaussians.features_dc[:, None], gaussians.features_rest), dim=1)
    most = gaussians.sh_degree
    gram = _gram(gaussians, cameras, values.shape[1])
    before, least = (highest - gone).clamp_max(most), torch.full_like(weight, torch.inf)
    best, degree = values, before
    for candidate in range(most + 1):
        kept = (candidate + 1) ** 2
        fitted = _fitted(gram, values, kept)
        change = fitted - values
        square = (change * (gram @ change)).sum(dim=(1, 2)) / 3
        cost = weight * square.clamp_min(0.0) + NUMBER_COST * 3 * (kept - 1)
        pays = (cost < least) & (candidate <= before)
        best = torch.where(pays[:, None, None], fitted, best)
        degree, least = torch.where(pays, candidate, degree), torch.where(pays, cost, least)
    gone = torch.where(degree < most, highest - degree, gone)  # higher ones may still come
    return Lowered(best[:, 0], best[:, 1:], gone)


def _fitted(gram: Float[Tensor, "n b b"], values: Float[Tensor, "n b 3"], kept: int) -> Tensor:
    """The first `kept` coefficients such that they look like all of them, and zeros: [n, b, 3]."""
    ridge = RIDGE * torch.eye(kept, dtype=gram.dtype, device=gram.device)
    # Unchecked: what is no number is repaired when the visit ends, and pays nothing until then.
    low, _ = torch.linalg.cholesky_ex(gram[:, :kept, :kept] + ridge)
    more = torch.cholesky_solve(gram[:, :kept, kept:] @ values[:, kept:], low)
    return torch.cat((values[:, :kept] + more, torch.zeros_like(values[:, kept:])), dim=1)


def _gram(gaussians: Gaussians, cameras: Float[Tensor, "v 22"], bases: int) -> Float[Tensor, "n b b"]:
    """Mean products of the harmonics in the directions of views. Each view counts by the square of a
    Gaussian's size there, and not at all where it is beside the picture. NaN where none shows it."""
    means = gaussians.means
    turns, shifts, focal, middle, size, centers, near = cameras.split((9, 3, 2, 2, 2, 3, 1), dim=1)
    turns, near = turns.view(-1, 3, 3), near[:, 0]
    # Matrices of Gaussians by views, for each axis.
    x, y, z = (means @ turn.T + shift for turn, shift in zip(turns.unbind(1), shifts.unbind(1), strict=True))
    per_unit = focal[:, 0] / torch.maximum(z, near)
    beyond = REACH * gaussians.scales.amax(dim=1, keepdim=True).exp() * per_unit
    seen = z > near
    for axis, offset in enumerate((x, y)):
        place = focal[:, axis] * offset / z + middle[:, axis]
        seen &= (place > -beyond) & (place < size[:, axis] + beyond)
    counts = torch.where(seen, per_unit.square(), 0.0)
    counts = counts / counts.sum(dim=1, keepdim=True)
    away = [means[:, axis, None] - centers[:, axis] for axis in range(3)]
    distance = sum(part.square() for part in away).sqrt().clamp_min(1e-12)
    harmonics = sh_basis_rows(*(part / distance for part in away))[: bases - 1]
    basis = torch.stack((torch.full_like(distance, SH_C0), *harmonics), dim=2)
    return (basis * counts[..., None]).mT @ basis
