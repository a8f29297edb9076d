"""Which block next, for how many steps, on which views: pure functions of integers.

One step budget serves the whole scene. What an epoch's steps draw of a block is proportional to the views
that see it, as in joint training: blocks that few see overfit otherwise.
"""

import math
import random
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import NamedTuple, TypeVar

T = TypeVar("T")

DEFAULT_BATCH = 4
"""Views in a step where there are several blocks, of one that was trained on many views."""
UNDER_TRAINED = 500
"""Views that a block was trained on, warm-up included, below which its steps draw one; two below twice as
many, and so on. Its steps are as large whatever they draw, see `rates_of_under_trained`."""
COARSE_MODEL_PASSES, WARM_UP_PASSES, LONGER = 24, 32, 2.4
"""Uses of each view in the warm-up: the first at most, where not all Gaussians have room. Elsewhere the
second at least, but no longer than so many times its share of the run."""
LEAST_SIDE = 100
"""Of a reduced picture, pixels, at least."""
FEW_VIEWS = 32
"""With more, a visit uses each less often, and is as long."""
SHORTER = 4
"""Visits are so many times shorter where all blocks are trained at once."""
DECAY_BEGINS, DECAYED_TO, DECAY_VIEWS = 0.6, 0.1, 1000
"""From this share of a run on learning rates fall, to this share of them for a block that was trained on so
many views, warm-up included, and less for one that saw fewer."""


class VisitPlan(NamedTuple):
    """One visit to come."""

    block: int
    steps: int
    batch: int = 0
    """Views in each step; 0 for as many as steps have at most."""


def warm_up_is_over(progress: float, uses: float, share: float, deferred: int) -> bool:
    """Whether the warm-up, with `share` of the run, used each view often enough; `deferred` have no room."""
    if deferred:
        return progress >= share or uses >= COARSE_MODEL_PASSES
    return progress >= share and (uses >= WARM_UP_PASSES or progress >= LONGER * share)


def passes_of_visit(passes: int, used: int, at_once: int, blocks: int) -> float:
    """How often a visit uses each view: `passes` times, where it is alone and that to the median block uses
    FEW_VIEWS or fewer. Visits in flight at once are shorter, by the share of other blocks."""
    alone = math.ceil(passes * min(1.0, FEW_VIEWS / max(used, 1)))
    unseen = min((at_once - 1) / max(blocks - 1, 1), 1.0)
    return alone / (1 + (SHORTER - 1) * unseen)


def plan_epoch(
    epoch: int,
    views: Mapping[int, int],
    passes: int | float,
    seed: int,
    each: int = 0,
    batches: Mapping[int, int] | None = None,
) -> tuple[VisitPlan, ...]:
    """The visits of one epoch, in a random order that depends on `seed` and `epoch` alone.

    Args:
        views: by block, the number of views that a visit uses; blocks with none are left out.
        each: steps of every visit, whatever its views; 0 shares them out by views.
        batches: by block, the views that a step draws; 1 where it is missing.
    """
    batches, order = batches or {}, sorted(block for block, count in views.items() if count > 0)
    random.Random(f"sweep {seed} {epoch}").shuffle(order)
    steps = {block: each or math.ceil(passes * views[block] / batches.get(block, 1)) for block in order}
    return tuple(VisitPlan(block, steps[block], batches.get(block, 0)) for block in order)


def views_per_step(batch: int, blocks: int, trained: int | None = None) -> int:
    """Resolves `TrainingConfig.batch` for a block that was trained on so many views; None for the most."""
    if batch:
        return batch
    most = 1 if blocks == 1 else DEFAULT_BATCH
    return most if trained is None else min(most, 1 << (trained // UNDER_TRAINED).bit_length())


def evenly(values: Sequence[T], wanted: int) -> list[T]:
    """So many of the values, as far apart from each other as from both ends; all if there are no more."""
    wanted = min(wanted, len(values))
    return [values[int((k + 0.5) * len(values) / wanted)] for k in range(wanted)]


def views_per_visit(seen: int, typical: int, limit: int) -> int:
    """How many of the `seen` views of a block a visit uses: the same share of every block's, `limit` for the
    median block, which `typical` views see, and twice the limit at most."""
    share = -(-seen * min(limit, typical) // typical)  # rounded up
    return min(seen, share, 2 * limit)


def visit_views(views: tuple[int, ...], count: int, visits: int, seed: int) -> tuple[int, ...]:
    """The `count` views of a block's visit after `visits` earlier ones: all are used equally often."""
    places = range(visits * count, (visits + 1) * count)
    return tuple(dict.fromkeys(_in_turn(views, place, f"cycle {seed}") for place in places))


def view_order(views: tuple[int, ...], steps: int, visit: int, seed: int) -> tuple[int, ...]:
    """The view of each step of a visit: shuffled passes over all views; use differs by at most one."""
    shuffled: list[int] = []
    rng = random.Random(f"views {seed} {visit}")
    while len(shuffled) < steps:
        one_pass = list(views)
        rng.shuffle(one_pass)
        shuffled += one_pass
    return tuple(shuffled[:steps])


def endless_order(views: tuple[int, ...], index: int, seed: int) -> int:
    """The view of step `index` where the number of steps is not known: shuffled passes over all views."""
    return _in_turn(views, index, f"scaffold {seed}")


def _in_turn(views: tuple[int, ...], index: int, name: str) -> int:
    number, place = divmod(index, len(views))
    return views[_one_pass(len(views), f"{name} {number}")[place]]


@lru_cache(maxsize=16)
def _one_pass(count: int, name: str) -> tuple[int, ...]:
    """The order of so many places that a name stands for."""
    shuffled = list(range(count))
    random.Random(name).shuffle(shuffled)
    return tuple(shuffled)


def exponential_decay(progress: float, final: float) -> float:
    """The share that is left, final^progress for progress 0..1, as 3DGS decays the rate of the means."""
    return final ** min(max(progress, 0.0), 1.0)


def final_decay(progress: float, views: int) -> float:
    """The share of the learning rates left to a block that was trained on so many views, see DECAY_BEGINS."""
    fallen = exponential_decay((progress - DECAY_BEGINS) / (1 - DECAY_BEGINS), DECAYED_TO)
    return fallen ** min(views / DECAY_VIEWS, 1.0)


def reduction_at(progress: float, coarse: float, shortest: int) -> int:
    """By how much pictures are reduced: to a quarter, then to half their width, until the share `coarse` of
    the run; `shortest` is the least side of any, pixels."""
    wanted = 4 if progress < coarse / 2 else 2 if progress < coarse else 1
    return max(by for by in (1, 2, 4) if by == 1 or (by <= wanted and shortest // by >= LEAST_SIDE))


def sh_degree_at(progress: float, ramp: float, highest: int) -> int:
    """The degree of spherical harmonics in use: one more at each third (for degree 3) of the ramp."""
    if ramp <= 0:
        return highest
    # 1e-9 keeps degree n exactly at n / highest of the ramp, where the product may fall just below n.
    return min(int(progress / ramp * highest + 1e-9), highest)
