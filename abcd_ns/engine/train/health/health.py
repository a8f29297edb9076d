"""Notices what goes wrong in the active block, counts it, and repairs what can be repaired.

In any run: gradients, moments and values that are no numbers (in exact joint training gradients alone). Where
blocks are trained within layers: oversized Gaussians. A run in which nothing goes wrong is the same with or
without all this, on a CPU bit for bit: healthy tensors are read, never written.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from abcd_ns.engine.events import Announcer, Repaired
from abcd_ns.engine.gaussians.block_state import MOMENTS, BlockState
from abcd_ns.engine.gaussians.param_swap import Optimizers, Params, active_gaussians
from abcd_ns.engine.render.loss import decibels
from abcd_ns.engine.store.commit import state_for_visit
from abcd_ns.engine.store.scene import VisitScene
from abcd_ns.engine.store.special_blocks import WHOLE
from abcd_ns.engine.train.health.health_rules import (
    HIDDEN,
    OVERSIZED_ANGLE,
    stand_ins,
    unsound,
    wider_than,
)
from abcd_ns.engine.train.health.step_guard import StepGuard
from abcd_ns.engine.train.health_record import BlockHealth, HealthByBlock
from abcd_ns.engine.train.run_state import ActiveVisit
from abcd_ns.engine.transfer import StepNumbers
from abcd_ns.engine.types import Gaussians, View

LATE_AFTER = 16
"""Steps without a fault after which an accelerator's gradients are looked at a step late, without a wait."""


class Health:
    """Watches the active block of a coordinator.

    Hooks into the optimizers, so that no caller can forget to ask: what they step with is numbers.

    Args:
        may_act: also shrink oversized Gaussians.
    """

    def __init__(
        self,
        scene: VisitScene,
        params: Params,
        optimizers: Optimizers,
        announce: Announcer,
        *,
        may_act: bool,
    ) -> None:
        self.may_act = may_act
        self._scene, self._params, self._optimizers, self._announce = scene, params, optimizers, announce
        self._active: ActiveVisit | None = None
        self._health_by_block: HealthByBlock = {}
        self._attached: Tensor | None = None
        self._resumed = False
        self._bad: Tensor | None = None
        self._shares: list[Tensor] = []
        self._numbers = StepNumbers(params["means"].device)
        self._guard = StepGuard(optimizers) if self._numbers.are_late else None
        self._clean, self._psnr = LATE_AFTER, math.nan
        for optimizer in optimizers.values():
            optimizer.register_step_pre_hook(self._clean_gradients)

    def begin_visit(self, active: ActiveVisit, health_by_block: HealthByBlock) -> None:
        """A block was attached.

        Args:
            health_by_block: the run's, to be written to.
        """
        self._active, self._health_by_block = active, health_by_block
        self._attached, self._bad, self._shares = self._params["means"], None, []
        self._resumed = active.saved
        self._clean, self._psnr = LATE_AFTER, math.nan

    def see(self, share: Float[Tensor, ""]) -> None:
        """Take note of how large a part of a picture the active block was, while none has shown it."""
        self._shares.append(share)

    def end_step(self, errors: Sequence[Float[Tensor, ""]] = ()) -> tuple[bool, float]:
        """Call after the optimizers stepped.

        Args:
            errors: the mean squared one of each picture that the step drew.

        Returns:
            Whether the step's gradients were all numbers, as far as is known; and the mean PSNR, dB: on an
            accelerator of the step before, NaN in a visit's first.
        """
        self._send(errors)
        self._read(all_but=int(self._numbers.are_late))
        if self._bad is None:
            self._clean += 1
            return True, self._psnr
        self.count("gradients", int(self._bad.sum()))
        self._bad, self._clean = None, 0
        self._repair()
        return False, self._psnr

    @torch.no_grad()
    def shrink_oversized(self, views: Iterable[View], spared: Bool[Tensor, "n"]) -> None:
        """Shrink Gaussians that are too large for every camera, along the axes that are.

        Photos may agree on such a Gaussian, as a far wall say. But its place in the order is that of its
        mean: from anywhere else it may come before what it lies behind, and veil half the picture.

        Args:
            spared: stay as they are.
        """
        if not self.may_act:
            return
        scales = self._params["scales"]
        over, allowed = wider_than(OVERSIZED_ANGLE, scales, self._params["means"], views)
        over &= ~spared[:, None]
        rows = over.any(dim=1).nonzero()[:, 0]
        if len(rows) == 0:
            return
        scales[rows] = torch.where(over[rows], allowed[rows], scales[rows])
        self._forget_moments("scales", rows)
        self.count("oversized", len(rows))

    @torch.no_grad()
    def largest(self, views: Iterable[View], spared: Bool[Tensor, "n"]) -> Float[Tensor, "n 3"]:
        """Logarithms of standard deviations that none may grow beyond, lest it be oversized. A value that is
        no number bounds nothing.

        Args:
            spared: may grow as they like.
        """
        scales = self._params["scales"]
        _, allowed = wider_than(OVERSIZED_ANGLE, scales, self._params["means"], views)
        return torch.maximum(scales, torch.where(spared[:, None], math.inf, allowed)).nan_to_num(math.inf)

    def end_visit(self, detach: Callable[[], BlockState]) -> BlockState:
        """What the visit leaves behind: the active block, repaired.

        Args:
            detach: takes the active block out.
        """
        self.look_over()
        state, record, active = detach(), self._record, self._active
        record.visits += 1
        if active.done:  # else time ran out before anybody could see
            record.hidden = not active.shown
        self._active = self._attached = None
        return state

    def count(self, what: str, count: int) -> None:
        """So much of the active block had to be repaired; see BlockHealth for what."""
        if count:
            record, active = self._record, self._active
            setattr(record, what, getattr(record, what) + count)
            alone = active is None or active.is_whole
            number = 0 if active is None else active.number
            self._announce(Repaired(number, None if alone else active.geometry.block, what, count))

    def look_over(self) -> None:
        """Repair all that is no number in the active block; call when a visit ends, and before saving."""
        self._read()
        self._repair()

    # -- numbers -------------------------------------------------------------------------------------

    def _clean_gradients(self, optimizer: torch.optim.Optimizer, args: Any, kwargs: Any) -> None:  # noqa: ARG002
        if self._guard is not None:
            late = self._clean >= LATE_AFTER and self._guard.works
            self._guard.record(optimizer, late)
            if late:
                return
        for parameter in optimizer.param_groups[0]["params"]:
            if parameter.grad is None:
                continue
            # One pass over memory; an overflow of the squares counts, as it would in Adam's second moment.
            size = float(torch.linalg.vector_norm(parameter.grad))
            if not math.isfinite(size):
                self._zero_bad_rows(parameter.grad)

    def _zero_bad_rows(self, gradient: Float[Tensor, "n ..."]) -> None:
        bad = ~torch.isfinite(gradient.square()).flatten(1).all(dim=1)
        gradient[bad] = 0.0
        if self._bad is not None and self._bad.shape != bad.shape:  # another block, in exact joint training
            self.count("gradients", int(self._bad.sum()))
            self._bad = None
        self._bad = bad if self._bad is None else self._bad | bad

    @torch.no_grad()
    def _repair(self) -> None:
        for name, optimizer in self._optimizers.items():
            adam = optimizer.state[self._params[name]]
            for moment in MOMENTS:
                if not math.isfinite(float(torch.linalg.vector_norm(adam[moment]))):
                    bad = ~torch.isfinite(adam[moment]).flatten(1).all(dim=1)
                    adam[moment][bad] = 0.0
                    self.count("moments", int(bad.sum()))
        gaussians = active_gaussians(self._params)
        rows = unsound(gaussians).nonzero()[:, 0]
        if len(rows) == 0:
            return
        sound = self._known(gaussians, rows).of_degree(gaussians.sh_degree)
        for name, value in gaussians.items():
            value[rows] = getattr(sound, name).to(value)
            self._forget_moments(name, rows)
        self.count("values", len(rows))

    def _known(self, gaussians: Gaussians, rows: Tensor) -> Gaussians:
        """Numbers for `rows`: as stored where rows still are what they were, else stand-ins."""
        active = self._active
        if active is not None and self._params["means"] is self._attached:
            before = state_for_visit(self._scene, active.geometry.block, self._resumed).gaussians
            if len(before) == len(gaussians):
                kept = before[rows.cpu()]
                if not bool(unsound(kept).any()):
                    return kept
        return stand_ins(gaussians[~unsound(gaussians)], len(rows))

    def _forget_moments(self, name: str, rows: Tensor) -> None:
        adam = self._optimizers[name].state[self._params[name]]
        for moment in MOMENTS:
            adam[moment][rows] = 0.0

    # -- accounts ------------------------------------------------------------------------------------

    def _send(self, errors: Sequence[Float[Tensor, ""]]) -> None:
        """All that the step tells, as one small tensor."""
        shares, self._shares = self._shares, []
        parts = {"shares": shares, "errors": list(errors)}
        if self._guard is not None:
            parts["bad"], self._guard.found = self._guard.found, []
        self._numbers.send(parts)

    def _read(self, all_but: int = 0) -> None:
        """Take note of what steps told, but for the last so many."""
        for numbers in self._numbers.read(all_but):
            if self._active is not None and not self._active.shown and numbers["shares"]:
                self._active.shown = float(torch.tensor(numbers["shares"]).max()) > HIDDEN
            psnrs = [decibels(error) for error in numbers["errors"]]
            self._psnr = sum(psnrs) / len(psnrs) if psnrs else math.nan
            skipped = int(sum(numbers.get("bad", ())))
            if skipped and self._clean >= LATE_AFTER:  # now row by row, so that the others are trained
                self._clean = 0
                self._repair()
            self.count("gradients", skipped)

    @property
    def _record(self) -> BlockHealth:
        block = WHOLE if self._active is None else self._active.geometry.block
        return self._health_by_block.setdefault(block, BlockHealth())
