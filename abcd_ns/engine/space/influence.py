"""How much a view shows of a block, and so which views are worth training it on.

The influence of a Gaussian on a view is the mean, over the image, of its weight alpha T in each pixel: what
it adds to the picture once everything before it is taken into account. Influences of all Gaussians and of
the background add up to 1. Rasterizers leave them on their way back, whatever is drawn (`blend_weights`): so
the warm-up, which draws the whole scene, tells them of the views that it has used (`InfluenceTable`), and the
others are drawn small for it.
"""

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import accumulate

import torch
from jaxtyping import Float, Int
from torch import Tensor

from abcd_ns.engine.gaussians.spherical_harmonics import SH_C0
from abcd_ns.engine.render import Rasterizer, Shot
from abcd_ns.engine.render.base import DEVICE_SPLATS, runs
from abcd_ns.engine.space.tree import BlockTree
from abcd_ns.engine.types import Gaussians, View

AT_ONCE = 1 << 17
"""Gaussians times views that are drawn in one pass by a CPU: of small images, calls would cost more than what
they compute."""
COARSE, COARSE_SIDE = 2, 80
"""Influences of whole views are found in images that are so many times smaller, and those of large images in
such as are about so many pixels long: what counts is the order of a block's views, and there may be many."""
UNSEEN = 2e-4
"""Influence that blocks may have together on a view whose layers leave them out."""
TINY = 1e-30
"""Keeps a block that no view shows from being divided by."""
DIGITS = 6
"""Decimals that are kept: a millionth of the image is less than a pixel."""

Influence = dict[int, dict[int, float]]
"""By block and by view, the influence of the block's Gaussians; of pairs that have any."""


def weights(
    gaussians: Gaussians, rasterizer: Rasterizer, shots: Sequence[Shot], *, antialiased: bool = False
) -> Float[Tensor, "v n"]:
    """For each shot the sum of each Gaussian's weights over its pixels."""
    if not len(gaussians):
        return gaussians.means.new_zeros(len(shots), 0)
    options = {"sh_degree": 0, "antialiased": antialiased, "blend_weights": True}
    rasters = rasterizer.draw(gaussians.detach(), shots, **options)
    leaves = {id(raster.info): raster.info["weights"] for raster in rasters}
    found = torch.autograd.grad(sum(raster.depth.sum() for raster in rasters), list(leaves.values()))
    # Shots that share an info are its cameras, in their order.
    rows = {info: iter(each) for info, each in zip(leaves, found, strict=True)}
    return torch.stack([next(rows[id(raster.info)]) for raster in rasters])


@torch.no_grad()
def weights_by_pixel(
    gaussians: Gaussians, rasterizer: Rasterizer, shot: Shot, *, antialiased: bool = False
) -> Float[Tensor, "h w"]:
    """The sum of the Gaussians' weights in each pixel of a shot, among what is frozen there: a picture of
    them in white, and of nothing else."""
    white = replace(gaussians.detach(), features_dc=torch.full_like(gaussians.features_dc, 0.5 / SH_C0))
    shot = replace(shot, frozen=shot.frozen and shot.frozen.black)
    (raster,) = rasterizer.draw(white, [shot], sh_degree=0, antialiased=antialiased)
    return raster.color[..., 0]


def share_shown(
    gaussians: Gaussians,
    rasterizer: Rasterizer,
    shot: Shot,
    front: Float[Tensor, "h w"] | None,
    *,
    antialiased: bool = False,
) -> float:
    """The influence of some Gaussians on the view of a shot that shows all of them, behind something of the
    transmittance `front`; None for nothing."""
    found = weights_by_pixel(gaussians, rasterizer, shot, antialiased=antialiased)
    shown = found if front is None else found * front
    return round(float(shown.sum()) / shot.view.full.pixels, DIGITS)


def influence(
    gaussians: Gaussians,
    owner: Int[Tensor, "n"],
    views: Iterable[View],
    rasterizer: Rasterizer,
    *,
    antialiased: bool = False,
) -> Influence:
    """The influence of every block on every view, from Gaussians that stand for the whole scene and their
    blocks."""
    blocks = int(owner.max()) + 1 if len(owner) else 0
    found: Influence = {}
    for shots in in_passes(gaussians, small_views(views)):
        each = weights(gaussians, rasterizer, shots, antialiased=antialiased)
        sums = each.new_zeros(len(shots), blocks).index_add_(1, owner, each).tolist()
        for view, row in zip((shot.view for shot in shots), sums, strict=True):
            _put(found, view.index, [value / view.full.pixels for value in row])
    return found


def small_views(views: Iterable[View]) -> list[View]:
    """As large as influences are found in."""
    return [coarser(view, max(COARSE, max(view.width, view.height) // COARSE_SIDE)) for view in views]


def in_passes(gaussians: Gaussians, small: Sequence[View]) -> Iterator[list[Shot]]:
    """Small images, whole, in runs that are best drawn at once. An accelerator is waited for once in each."""
    splats = AT_ONCE if gaussians.device.type == "cpu" else DEVICE_SPLATS
    shots = [Shot(view, view.full) for view in small]
    return runs(shots, gaussians=len(gaussians), splats=splats, padded=True)


class InfluenceTable:
    """The influence of every block on the views that were drawn to train the whole scene, as it was when each
    was last drawn: the drawings know it. On the device; nothing waits for it until it is asked for. What is
    `known` is there to begin with."""

    def __init__(
        self, tree: BlockTree, views: Iterable[int], known: Influence, device: torch.device | str
    ) -> None:
        self._tree, self._means = tree, None
        self._row = {view: row for row, view in enumerate(views)}
        table = torch.full((len(self._row), tree.num_blocks), torch.nan)
        for view in {view for of_block in known.values() for view in of_block}:
            row = [known.get(block, {}).get(view, 0.0) for block in range(tree.num_blocks)]
            table[self._row[view]] = torch.tensor(row)
        self._table = table.to(device)

    def note(self, means: Tensor, views: Sequence[View], weights: Float[Tensor, "v n"]) -> None:
        """Some views have been drawn.

        Args:
            means: of all Gaussians; their blocks are looked up when it is another tensor than before.
            weights: of each in each view, summed over pixels.
        """
        if self._means is not means:
            self._means, self._owner = means, self._tree.assign(means.detach())
        sums = weights.new_zeros(len(views), self._tree.num_blocks).index_add_(1, self._owner, weights)
        for view, row in zip(views, sums, strict=True):
            self._table[self._row[view.index]] = row / view.full.pixels

    def found(self) -> tuple[Influence, set[int]]:
        """By now, and the views that it says nothing of."""
        influence: Influence = {}
        unknown = set[int]()
        for view, row in zip(self._row, self._table.tolist(), strict=True):
            if all(map(math.isfinite, row)):
                _put(influence, view, row)
            else:
                unknown.add(view)
        return influence, unknown


def _put(influence: Influence, view: int, row: Sequence[float]) -> None:
    for block, value in enumerate(row):
        if share := round(value, DIGITS):
            influence.setdefault(block, {})[view] = share


def overlaps(influence: Influence, blocks: Iterable[int], others: Iterable[int]) -> list[float]:
    """How much of each block is shown where others are: the sum over these of influences' cosines."""
    beside: Counter[int] = Counter()
    for theirs in (influence.get(other, {}) for other in others):
        length = max(math.hypot(*theirs.values()), TINY)
        beside.update({view: share / length for view, share in theirs.items()})
    found = []
    for own in (influence.get(block, {}) for block in blocks):
        shared = sum(own[view] * beside[view] for view in own.keys() & beside)
        found.append(round(shared / max(math.hypot(*own.values()), TINY), DIGITS))
    return found


def coarser(view: View, times: int) -> View:
    """The same camera with an image that is `times` smaller, rounded up to whole pixels."""
    return view.resized(1 / times, -(-view.width // times), -(-view.height // times))


def visible_blocks(influence: Influence, views: Iterable[int], blocks: int) -> dict[int, tuple[int, ...]]:
    """By view, all of the `blocks` but those that together are UNSEEN of the picture, as where others hide
    them. Blocks of which nothing is known count as visible; such views are left out."""
    found = {}
    for view in views:
        shares = {block: known.get(view, 0.0) for block, known in influence.items()}
        ranked = sorted(shares, key=lambda block: (shares[block], block))
        hidden = sum(held <= UNSEEN for held in accumulate(shares[block] for block in ranked))
        if hidden < len(ranked):
            found[view] = tuple(sorted(set(range(blocks)).difference(ranked[:hidden])))
    return found


def worth_training(views: Mapping[int, float], share: float) -> tuple[int, ...]:
    """The fewest of the views, given with a block's influence on each, that hold at least `share` of it; by
    increasing index."""
    ranked = sorted(views, key=lambda view: (-views[view], view))
    wanted, held = share * sum(views.values()), 0.0
    for count, view in enumerate(ranked):
        if held >= wanted:
            return tuple(sorted(ranked[:count]))
        held += views[view]
    return tuple(sorted(ranked))
