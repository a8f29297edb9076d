"""The block that is being trained: its way in and out of the optimizers, its growth, and its clocks."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool
from torch import Tensor

from abcd_ns.engine.gaussians.block_state import BlockState, Clocks
from abcd_ns.engine.gaussians.param_swap import active_gaussians, attach, detach, raise_degree
from abcd_ns.engine.gaussians.spherical_harmonics import degrees_in_use
from abcd_ns.engine.store.commit import rows_for_visit, state_for_visit
from abcd_ns.engine.train.density import pruning
from abcd_ns.engine.train.density.control import DensityClock, Infos
from abcd_ns.engine.train.density.degrees import GONE, LATE_START, START, are_gone, lower
from abcd_ns.engine.train.density.growing import Judged
from abcd_ns.engine.train.density.pruning import FOG, SEEN_THROUGH, SHOWN
from abcd_ns.engine.train.memory import check_room
from abcd_ns.engine.train.run import TrainingRun
from abcd_ns.engine.train.run_state import ActiveVisit, VisitKind
from abcd_ns.engine.types import Gaussians

LARGEST = "largest"
"""Name of a statistic, [n, 3]: see Health.largest. Only while a visit is under way."""
FILLS = 0.01
"""Share of a block's views: oversized Gaussians that fill more are no accident."""

CUT_BY_MEMORY = 0.5
"""Part of the minimum contribution that is asked where memory cuts the scene. Its blocks are trained on fewer
views than one block would be, and use less of what they have by then."""


class ActiveBlock:
    """What is active in a run's parameters, with what density control has gathered of it."""

    def __init__(self, run: TrainingRun) -> None:
        self._run = run
        self.growth: dict[str, Tensor] = {}
        self.clocks = Clocks()
        self.is_new = False
        """Whether deferred points joined it when its visit began: they have had no time to be of use."""
        self._highest = run.config.sh_degree
        self._held: tuple[Tensor, Tensor] | None = None
        run.optimizers["features_rest"].register_step_pre_hook(self._hold_degrees)

    def __len__(self) -> int:
        return len(self._run.params["means"])

    def attach(self, active: ActiveVisit, batch: int, sh_degree: int) -> None:
        """Make the block of a visit active, as it is stored, for steps of `batch` views; an OutOfRoomError if
        it does not fit. Harmonics above `sh_degree` take no memory, but where the block has some."""
        run, which = self._run, (self._run.scene, active.geometry.block, active.saved)
        check_room(rows_for_visit(*which), sh_degree, run.device)
        stored = state_for_visit(*which)
        if sh_degree < self._highest:  # what a block begins with may have more
            used = degrees_in_use([stored.gaussians.features_rest])
            stored = stored.of_degree(max((sh_degree, *used.unique().tolist())))
        stored = stored.to(run.device)
        self.is_new = not active.is_whole and bool(run.scene.state(active.geometry.block).deferred.any())
        if active.done == 0 and not run.config.recipe.keep_moments:
            # As if no optimizer had ever seen it.
            stored = replace(BlockState.fresh(stored.gaussians), clocks=replace(stored.clocks, adam_views=0))
        attach(stored, run.params, run.optimizers, batch=batch)
        run.health.begin_visit(active, run.state.health)
        self.growth = {name: value.clone() for name, value in stored.growth.items()}
        self.clocks = stored.clocks
        begins = active.done == 0 and not active.saved
        if begins and not active.is_alone:  # which may have had no time to be of use
            self._lower_degrees()
        if begins and self.clocks.visits == 0:
            run.health.shrink_oversized(run.views.values(), self._filling())
        self._hold_sizes()

    def raise_degree(self, sh_degree: int) -> None:
        """Harmonics up to this degree are in training from now on."""
        raise_degree(self._run.params, self._run.optimizers, sh_degree)
        self._run.state.sh_degree = max(self._run.state.sh_degree, sh_degree)

    def detached(self) -> BlockState:
        """The active block, repaired, on the CPU; it stays active."""
        self._run.health.look_over()
        if GONE in self.growth:  # what was repaired may have them again
            rest = self._run.params["features_rest"]
            rest.data.masked_fill_(are_gone(self.growth[GONE], rest, self._highest), 0.0)
        state = detach(self._run.params, self._run.optimizers, self.growth, self.clocks)
        return state.of_degree(self._highest)

    def let_go(self) -> None:
        """No block is active any more, and the device has its memory back."""
        nobody = BlockState.fresh(Gaussians.empty(self._highest, self._run.device))
        attach(nobody, self._run.params, self._run.optimizers)
        self.growth, self._held = {}, None

    def end_visit(self, counts: bool) -> None:
        """A visit has ended. Only one that `counts` is counted."""
        self.growth.pop(LARGEST, None)
        self.clocks = replace(self.clocks, visits=self.clocks.visits + counts)

    def gather(self, infos: Infos, judged: Sequence[Judged]) -> None:
        """Add to the statistics what a part of a step drew, see DensityControl.gather."""
        run = self._run
        self.growth = run.density.gather(run.params, self.growth, infos, judged, len(run.active.trained_on))

    def after_step(
        self, taken: int, batch: int, room: int | None, infos: Infos, judged: Sequence[Judged]
    ) -> DensityClock:
        """The optimizers have stepped: grow and prune, where it is time for that.

        Args:
            taken: views that the step drew, of the `batch` that it was made for.
            room: Gaussians that may be added.
            infos, judged: of what was not gathered yet; none where gradients were no numbers.
        """
        run, clocks = self._run, self.clocks
        self.clocks = replace(clocks, adam_views=clocks.adam_views + batch, steps=clocks.steps + taken)
        clock = self.density_clock(taken, batch, room)
        for parameter in run.params.values():  # their memory is for what growth takes
            parameter.grad = None
        self.gather(infos, judged)
        self.growth, refined = run.density.after_step(run.params, run.optimizers, self.growth, clock)
        if refined:
            self.clocks = replace(self.clocks, refined=clock.steps)
            self.growth.pop(LARGEST, None)
        self._hold_sizes()
        return clock

    @torch.no_grad()
    def _hold_sizes(self) -> None:
        """Nothing becomes oversized but what fills much of the block's views; what is so already stays."""
        run = self._run
        if not run.health.may_act:
            return
        if LARGEST not in self.growth:
            self.growth[LARGEST] = run.health.largest(run.views.values(), self._filling())
        else:
            torch.minimum(run.params["scales"], self.growth[LARGEST], out=run.params["scales"].data)

    def _filling(self) -> Bool[Tensor, "n"]:
        """Which Gaussians are known to fill more than FILLS of the block's views."""
        run = self._run
        if not pruning.have_contributions(self.growth):
            return torch.zeros(len(self), dtype=torch.bool, device=run.device)
        pixels = sum(run.views[view].full.pixels for view in run.active.trained_on)
        return pruning.contributions(self.growth) > FILLS * pixels

    def prune(self) -> None:
        """Take out Gaussians that fill too little of the block's views, and harmonics that change too little.
        What is seen from now on soon counts for more."""
        run, before, least = self._run, len(self), 0.0
        if before and run.density.config.prunes and run.share >= run.config.density.refine_stop:
            drawn = active_gaussians(run.params).detach(), run.rasterizer, run.config.antialiased
            trained_on = [run.views[view] for view in run.active.trained_on]
            least = pruning.veils(list(run.views.values()), *drawn)
            least = least.maximum(SHOWN * pruning.covered(trained_on, *drawn))
            faint = torch.sigmoid(run.params["opacities"][:, 0]) < SEEN_THROUGH
            least = least.maximum(torch.where(faint, pruning.fog(trained_on, *drawn) / FOG, 0.0))
        part = CUT_BY_MEMORY if run.config.limits.block_limit and run.scene.tree.num_blocks > 1 else 1.0
        self.growth = run.density.prune(run.params, run.optimizers, self.growth, run.share, least, part)
        run.health.count("pruned", before - len(self))
        self._lower_degrees()
        self.growth = pruning.faded(self.growth)

    def _lower_degrees(self) -> None:
        """Let spherical harmonics go that change too little in the block's views, once it is time."""
        run = self._run
        start = LATE_START if run.config.limits.late_harmonics else START
        if run.density.config.prunes and run.share >= start:
            views = [run.views[view] for view in run.active.trained_on]
            self.growth = lower(run.params, run.optimizers, self.growth, views, self._highest)

    def _hold_degrees(self, *_: object) -> None:
        """Before the optimizer steps: harmonics that are gone get no gradient."""
        gone, rest = self.growth.get(GONE), self._run.params["features_rest"]
        if gone is None or rest.grad is None:
            return
        if self._held is None or self._held[0] is not gone:
            degrees = torch.arange(1, self._highest + 1, device=gone.device)[:, None]
            self._held = gone, (degrees <= self._highest - gone).to(rest.dtype)[..., None, None]
        # Degree by degree: a CPU takes eight times as long for a mask of all coefficients.
        for degree, kept in enumerate(self._held[1], start=1):
            rest.grad[:, degree**2 - 1 : (degree + 1) ** 2 - 1].mul_(kept)

    def density_clock(self, taken: int, batch: int, room: int | None) -> DensityClock:
        """What decides whether to refine, see `after_step`."""
        run, active = self._run, self._run.active
        return DensityClock(
            progress=run.share,
            steps=self.clocks.steps,
            taken=taken,
            views=len(active.trained_on),
            visit=active.steps * batch if active.kind is VisitKind.BLOCK else None,
            room=room,
            refined=self.clocks.refined,
            first=run.among_others and self.clocks.visits == 0,
            spent=active.done / active.steps if run.among_others else 0.0,
        )
