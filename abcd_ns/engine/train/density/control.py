"""Growing and pruning the active block, on the block's own clock.

What is worth it is split (see `growing`), what fills little goes (see `pruning`). gsplat's strategies keep
a schedule in absolute steps of one global run. Here it is in shares of the run and in the block's own steps.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from gsplat.strategy import ops as gsplat_ops
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.gaussians.param_swap import Optimizers, Params, active_gaussians
from abcd_ns.engine.render.projection import SPLATS, Primitive
from abcd_ns.engine.render.splat_kernels import MIN_ALPHA
from abcd_ns.engine.train.density import growing, pruning
from abcd_ns.engine.train.density.growing import WORTH, Judged

REFINE_UNTIL = 0.5
"""Share of a visit after which a block is not refined: the rest makes good what growing upset."""
LEAST_REFINEMENTS = 4
"""Of a block in a whole run, however many views show it."""
USUAL_REFINEMENTS, USUAL_VIEWS = 20, 100
"""A block that few views show is refined every so many views, and at least so many times in a run ..."""
USUALLY_SEEN = 0.4
"""... where a picture shows this share of its Gaussians or more. Where it shows less, they learn less from as
many views, so that the block is refined less often."""
MOST_NEW = 0.1
"""Gaussians that one refinement may add, as a share of those that are trained; at least one. A block among
others is refined about once a visit, and may add a tenth for each refinement that it went without."""
MANY_VIEWS = 25
"""Of fewer, what a Gaussian contributes sums up to less: the minimum is in proportion to them."""
Infos = tuple[dict[str, Any], ...]
"""gsplat's `info` of one or more drawings."""


@dataclass
class DensityConfig:
    """When and how the number of Gaussians changes."""

    strategy: Literal["default", "off"] = "default"
    """default: split by error, and prune. off: neither."""
    max_gaussians: int = 0
    """Limit for the whole scene. 0 is none. Of more points, a random choice starts."""
    min_contribution: float = 8.0
    """Minimum contribution, px: prune a Gaussian whose blend weights in all views of its block sum to less.
    It rises from 0 until growth ends, to half of this where memory cuts the scene. Of n < 25 training views
    it is n / 25. 0 turns all pruning by contribution off, of floaters too, and the final pruning."""
    split_pixels: float = 8.0
    """Split a Gaussian if that removes as much squared error as this many average pixels have.
    Both count in all views of its block. A refinement splits a tenth of the scene at most. In visits a
    block makes up for refinements that it went without."""
    refine_start: float = 1 / 60
    """Share of the run before the first refinement (500 of 30,000 steps in splatfacto)."""
    refine_stop: float = 0.5
    """Share of the run after which no Gaussian is split. A block in its first visit grows on until 0.7."""
    refine_every: int = 0
    """Views drawn to train a block between its refinements. 0: 100, fewer in a short run, which refines it 20
    times; more where a picture shows less than 40% of the block. As many as show it if these are more, but no
    more than a quarter of those drawn while it grows."""
    cull_alpha_thresh: float = 0.005
    """Opacity under which a Gaussian is pruned."""

    @property
    def prunes(self) -> bool:
        """Whether Gaussians go that contribute too little; the rasterizer must leave `weights` then."""
        return self.min_contribution > 0 and self.strategy != "off"

    def for_views(self, count: int) -> "DensityConfig":
        """The same for a scene of so many training views, see MANY_VIEWS."""
        return replace(self, min_contribution=self.min_contribution * min(count / MANY_VIEWS, 1.0))

    @property
    def limit(self) -> int | None:
        """Gaussians in the whole scene at most, or None."""
        return self.max_gaussians or None


@dataclass(frozen=True)
class DensityClock:
    """Where the run and the active block stand; all that decides whether to refine."""

    progress: float
    """Share of the run that is done: 0..1."""
    steps: int
    """Views that were drawn to train the block so far, this step's included."""
    taken: int
    """This step's."""
    views: int
    """Views that the block is trained on."""
    room: int | None
    """Gaussians that may still be added to the scene; None for no limit."""
    refined: int = 0
    """`steps` when the block was last refined."""
    first: bool = False
    """Whether a block among others is in its first visit: all it has is what the warm-up had room for."""
    spent: float = 0.0
    """Share of the visit that is done; 0 in the warm-up and where there are no other blocks."""
    visit: int | None = None
    """Views that the visit to a block among others draws; None for another. A block is refined once a visit
    even if thousands of views show it."""

    def reached(self, every: int) -> bool:
        """Whether `steps` has come to a multiple of `every` in this step."""
        return self.steps // every > (self.steps - self.taken) // every


class DensityControl:
    """Applies the configured strategy to the active block."""

    def __init__(self, config: DensityConfig, primitive: Primitive = SPLATS) -> None:
        self.config, self._axes = config, primitive.axes

    def is_due(self, clock: DensityClock, seen: float = 1.0) -> bool:
        """Whether this step refines, where a picture shows the share `seen` of the block in the mean."""
        if not self.config.refine_start <= clock.progress < self._ends(clock.first):
            return False
        return clock.spent <= REFINE_UNTIL and clock.steps - clock.refined >= self._every(clock, seen)

    def _every(self, clock: DensityClock, seen: float) -> int:
        """Views between refinements."""
        views = clock.views if clock.visit is None else min(clock.views, clock.visit)
        usual = self._usual(clock, 1.0)
        wanted = max(views, self._usual(clock, seen))
        every = max(usual, min(wanted, int(self._growing(clock) / LEAST_REFINEMENTS)), 1)
        if clock.first and clock.visit is not None:  # it was last refined in the warm-up, perhaps just now
            every = min(every, max(int(REFINE_UNTIL * clock.visit) - clock.taken, 1))
        return every

    def _usual(self, clock: DensityClock, seen: float) -> int:
        """Views between refinements of a block that few views show."""
        if self.config.refine_every:
            return self.config.refine_every
        usual = min(USUAL_VIEWS, int(self._growing(clock) / USUAL_REFINEMENTS))
        return int(usual * max(USUALLY_SEEN / max(seen, 1e-9), 1.0))

    def _growing(self, clock: DensityClock) -> float:
        """Views that train the block while it grows, if the run goes on as it has so far."""
        pace = clock.steps / max(clock.progress, 1e-9)
        return max(self._ends(clock.first) - self.config.refine_start, 0.0) * pace

    def most_new(self, clock: DensityClock, seen: float) -> float:
        """Share of its Gaussians that a refinement may add."""
        if clock.visit is None:
            return MOST_NEW
        missed = (clock.steps - clock.refined) / max(self._usual(clock, seen), 1)
        missed *= 2 if clock.first else 1  # all it has is what the warm-up had room for
        return min((1 + MOST_NEW) ** max(missed, 1.0) - 1, 1.0)

    def asks(self, progress: float, first: bool) -> bool:
        """Whether growth is under way or to come: residuals are summed for it. See DensityClock."""
        return self.config.strategy == "default" and progress < self._ends(first)

    def _ends(self, first: bool) -> float:
        """Share of the run after which nothing grows."""
        begins, ends = self.config.refine_start, self.config.refine_stop
        return max(ends, pruning.LAST) if first and begins < ends else ends

    def gather(
        self,
        params: Params,
        growth: dict[str, Tensor],
        infos: Infos,
        judged: Sequence[Judged],
        views: int,
    ) -> dict[str, Tensor]:
        """The block's statistics with what drawings of some of its views add.

        Args:
            growth: the statistics so far, each [n, ...]; WORTH is changed in place.
            infos, judged: of drawings, after backward; pictures whose residuals were summed.
        """
        if self.config.strategy == "off" or len(params["means"]) == 0:
            return growth
        sums = pruning.blend_sums(infos, views)
        growth = {**growth, **{name: growth.get(name, 0.0) + value for name, value in sums.items()}}
        for picture in judged:
            growing.add_picture(growth, active_gaussians(params).detach(), self._axes, picture)
        return growth

    def after_step(
        self, params: Params, optimizers: Optimizers, growth: dict[str, Tensor], clock: DensityClock
    ) -> tuple[dict[str, Tensor], bool]:
        """Refine when it is time, by what was gathered. Call after Adam's step; gives the block's statistics
        from now on, and whether it was refined."""
        if self.config.strategy == "off" or len(params["means"]) == 0:
            return growth, False
        if not self.asks(clock.progress, clock.first):
            growth.pop(WORTH, None)
        # What a picture shows is asked for last: an accelerator is waited for.
        if WORTH not in growth or not (self.is_due(clock) and self.is_due(clock, growing.share_seen(growth))):
            return growth, False
        return self._refined(params, optimizers, growth, clock), True

    def prune(
        self,
        params: Params,
        optimizers: Optimizers,
        growth: dict[str, Tensor],
        progress: float,
        required: Float[Tensor, "n"] | float = 0.0,
        part: float = 1.0,
    ) -> dict[str, Tensor]:
        """Take out what fills too little of the block's views, at a share of the run, by this part of the
        minimum, or less than `required`, px; floaters; and what is too faint for any picture to show, which
        nothing would train again. Gives the block's statistics from now on."""
        if not self.config.prunes or not pruning.have_contributions(growth):
            return growth
        bounds = part * self.config.min_contribution, pruning.FAINT
        least, faint = (pruning.risen(bound, progress, self.config.refine_stop) for bound in bounds)
        opacities = torch.sigmoid(params["opacities"][:, 0])
        found = pruning.contributions(growth)
        drop = (found <= least) | (found < required) | (opacities < MIN_ALPHA)
        drop |= pruning.floaters(growth, opacities, faint)
        growth = dict(growth)  # rows are taken out of it
        if bool(drop.any()):
            gsplat_ops.remove(params, optimizers, growth, drop)
        return growth

    def _refined(
        self, params: Params, optimizers: Optimizers, growth: dict[str, Tensor], clock: DensityClock
    ) -> dict[str, Tensor]:
        wanted, axis = growing.worth(growth, clock.views, self.config.split_pixels)
        most = math.ceil(self.most_new(clock, growing.share_seen(growth)) * len(wanted))
        room = most if clock.room is None else min(most, clock.room)
        growth = growing.split_gaussians(params, optimizers, growth, growing.chosen(wanted, room), axis)
        growth[WORTH] = torch.zeros_like(growth[WORTH])
        faint = torch.sigmoid(params["opacities"][:, 0]) < self.config.cull_alpha_thresh
        if bool(faint.any()):
            gsplat_ops.remove(params, optimizers, growth, faint)
        return growth
