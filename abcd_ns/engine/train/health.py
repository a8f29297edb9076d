"""Notices what goes wrong in the active block, counts it, and repairs what can be repaired.

That is gradients, moments and values that are no numbers; in exact joint training gradients alone. Where
blocks are trained within layers it is oversized Gaussians, too. Healthy tensors are read, never written.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from abcd_ns.engine.events import Announcer, Repaired
from abcd_ns.engine.gaussians.adam import Adam
from abcd_ns.engine.gaussians.block_state import MOMENTS
from abcd_ns.engine.gaussians.param_swap import Optimizers, Params, active_gaussians
from abcd_ns.engine.render.cuda import fused
from abcd_ns.engine.render.loss import decibels
from abcd_ns.engine.store.commit import state_for_visit
from abcd_ns.engine.store.scene import VisitScene
from abcd_ns.engine.store.special_blocks import WHOLE
from abcd_ns.engine.train.run_state import ActiveVisit, BlockHealth, HealthByBlock
from abcd_ns.engine.transfer import StepNumbers, upload
from abcd_ns.engine.types import Gaussians, View, centers_of

LATE_AFTER = 16
"""Steps without a fault after which an accelerator's gradients are looked at a step late, without a wait."""
STAND_IN_OPACITY = -9.0
"""Logit of the opacity of a Gaussian that takes the place of one that was lost; far below MIN_ALPHA."""
LARGEST_LOG_SCALE = 40.0
"""A standard deviation of e^40; its square still is a number in float32."""
OVERSIZED_ANGLE = 0.3
"""An oversized Gaussian's standard deviation is over this share of its distance to the nearest camera."""
HIDDEN = 1e-4
"""A block that is no larger share of any picture is hidden: rasterizers stop at so little light."""
DISTANCES_AT_ONCE = 1 << 22
"""Between Gaussians and cameras."""


class Health:
    """Watches the active block, through hooks in the optimizers; bounds its scales only if it `may_act`."""

    def __init__(
        self, scene: VisitScene, params: Params, optimizers: Optimizers, announce: Announcer, *, may_act: bool
    ) -> None:
        self.may_act = may_act
        self._scene, self._params, self._optimizers, self._announce = scene, params, optimizers, announce
        self._numbers = StepNumbers(params["means"].device)
        self._guard = StepGuard(optimizers) if self._numbers.are_late else None
        self.begin_visit(None, {})
        for optimizer in optimizers.values():
            optimizer.register_step_pre_hook(self._clean_gradients)

    def begin_visit(self, active: ActiveVisit | None, health_by_block: HealthByBlock) -> None:
        """A block was attached, if any; what is found is added to the run's `health_by_block`."""
        self._active, self._health_by_block = active, health_by_block
        self._resumed = active is not None and active.saved
        self._attached = self._params["means"]
        self._bad: Tensor | None = None
        self._shares: list[Tensor] = []
        self._clean, self._psnr = LATE_AFTER, math.nan

    @torch.no_grad()
    def see(self, in_front: Float[Tensor, "h w"] | None, own: Float[Tensor, "h w"]) -> None:
        """Note how large a part of a picture the active block can be, while none has shown it: by the
        transmittance of what lies before it, if anything, and its own, with what was sorted in."""
        alpha = 1 - own
        self._shares.append((alpha if in_front is None else in_front * alpha).mean())

    def end_step(self, errors: Sequence[Float[Tensor, ""]] = ()) -> tuple[bool, float]:
        """Call after the optimizers stepped, with the mean squared error of each picture that the step drew.
        Gives whether its gradients were all numbers, as far as known, and its PSNR, dB; see StepTaken."""
        parts = {"shares": self._shares, "errors": list(errors)}
        self._shares = []
        if self._guard is not None:
            parts["bad"], self._guard.found = self._guard.found, []
        self._numbers.send(parts)
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
        """Shrink Gaussians, but for the spared, that are too large for every camera, along the axes that are.
        Photos may agree on one. But it is sorted by its mean: from elsewhere it may veil half the picture."""
        if not self.may_act:
            return
        scales, allowed = self._params["scales"], widest(self._params["means"], views)
        over = (scales > allowed) & ~spared[:, None]
        rows = over.any(dim=1).nonzero()[:, 0]
        if len(rows) == 0:
            return
        scales[rows] = torch.where(over[rows], allowed[rows], scales[rows])
        self._forget_moments("scales", rows)
        self.count("oversized", len(rows))

    @torch.no_grad()
    def largest(self, views: Iterable[View], spared: Bool[Tensor, "n"]) -> Float[Tensor, "n 3"]:
        """Logarithms of standard deviations that none but the spared may grow beyond."""
        scales, allowed = self._params["scales"], widest(self._params["means"], views)
        return torch.maximum(scales, torch.where(spared[:, None], math.inf, allowed)).nan_to_num(math.inf)

    def end_visit(self) -> None:
        """The visit to the active block, which was looked over, is over."""
        record, active = self._record, self._active
        record.visits += 1
        if active.done:  # else time ran out before anybody could see
            record.hidden = not active.shown
        self._active = self._attached = None

    def count(self, what: str, count: int) -> None:
        """So much of the active block had to be repaired; `what` is a field of BlockHealth."""
        if count:
            record, active = self._record, self._active
            setattr(record, what, getattr(record, what) + count)
            number = 0 if active is None else active.number
            block = None if active is None or active.is_whole else active.geometry.block
            self._announce(Repaired(number, block, what, count))

    def look_over(self) -> None:
        """Repair all that is no number in the active block; call before it is persisted."""
        self._read()
        self._repair()

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


class StepGuard:
    """Has an accelerator skip a step whose gradients are no numbers, while the host knows of nothing.

    It tells fused Adams by `found_inf`, as a GradScaler does. Those that are `Adam` share one step count,
    which is advanced here: one kernel for all of them.
    """

    def __init__(self, optimizers: Mapping[str, torch.optim.Optimizer]) -> None:
        self._optimizers = optimizers
        self._told: list[torch.optim.Optimizer] = []
        self._found: Float[Tensor, ""] | None = None
        self.found: list[Float[Tensor, ""]] = []
        """1 for each round of steps that was skipped, 0 for the others; the reader empties it."""

    @property
    def works(self) -> bool:
        """Whether all optimizers can be told."""
        return all(optimizer.defaults.get("fused") for optimizer in self._optimizers.values())

    def record(self, optimizer: torch.optim.Optimizer, skips: bool) -> None:
        """Call before it steps. With `skips` all do nothing if any gradient is no number."""
        if not self._told or any(told is optimizer for told in self._told):
            self._told, self._found = [], self._begin(skips)
        self._told.append(optimizer)
        optimizer.found_inf = self._found

    @torch.no_grad()
    def _begin(self, skips: bool) -> Float[Tensor, ""] | None:
        """Count a round of steps; whether it is skipped, if it may be."""
        count, norms = self._count(), self._norms() if skips else []
        if not norms:
            if count is not None:
                count.add_(1)
            return None
        found = None if count is None else fused.skips(count, norms)
        if found is None:
            sound = torch.stack(norms).sum() < math.inf
            found = torch.logical_not(sound, out=torch.empty((), device=sound.device))
            if count is not None:
                count.add_(sound)
        self.found.append(found)
        return found

    def _count(self) -> Float[Tensor, ""] | None:
        """The steps of all that are `Adam`, which share it from now on."""
        count = None
        for optimizer in self._optimizers.values():
            if isinstance(optimizer, Adam):
                optimizer.counts = False
                for state in optimizer.state.values():
                    count = state["step"] if count is None else count
                    state["step"] = count
        return count

    def _norms(self) -> list[Float[Tensor, ""]]:
        """Of all gradients. An overflow of the squares counts, as it would in Adam's second moment."""
        parameters = [p for o in self._optimizers.values() for p in o.param_groups[0]["params"]]
        gradients = [p.grad for p in parameters if p.grad is not None and p.grad.numel()]
        return list(torch._foreach_norm(gradients)) if gradients else []


def unsound(gaussians: Gaussians) -> Bool[Tensor, "n"]:
    """Which Gaussians hold a value that is no number, or a scale whose square is none."""
    bad = gaussians.scales.amax(dim=1) > LARGEST_LOG_SCALE
    for _, value in gaussians.items():
        bad = bad | ~torch.isfinite(value).flatten(1).all(dim=1)
    return bad


@torch.no_grad()
def widest(means: Float[Tensor, "n 3"], views: Iterable[View]) -> Float[Tensor, "n 1"]:
    """Logarithm of the largest standard deviation that is not oversized for the nearest camera."""
    views = tuple(views)
    near = torch.tensor([[view.near] for view in views], dtype=torch.float64)
    cameras = upload(torch.cat((centers_of(views), near), dim=1).to(means.dtype), means.device)
    nearest = means.new_full((len(means),), math.inf)
    for few in cameras.split(max(DISTANCES_AT_ONCE // max(len(means), 1), 1)):
        nearest = torch.minimum(nearest, torch.maximum(_distances(means, few[:, :3]), few[:, 3]).amin(dim=1))
    return (OVERSIZED_ANGLE * nearest).log()[:, None]


def _distances(ours: Float[Tensor, "n 3"], theirs: Float[Tensor, "m 3"]) -> Float[Tensor, "n m"]:
    """Not by a matrix product, which loses what is near."""
    if ours.device.type == "cpu":  # elsewhere this makes a block of threads for each distance
        return torch.cdist(ours, theirs, compute_mode="donot_use_mm_for_euclid_dist")
    return torch.linalg.vector_norm(ours[:, None] - theirs, dim=-1)


def stand_ins(sound: Gaussians, count: int) -> Gaussians:
    """`count` Gaussians amid the `sound` ones, as large as they usually are, and too faint to be drawn."""
    values = {name: value.new_zeros((count, *value.shape[1:])) for name, value in sound.items()}
    for name in ("means", "scales") if len(sound) else ():
        values[name] += getattr(sound, name).median(dim=0).values
    values["quats"][:, 0] = 1.0
    values["opacities"] += STAND_IN_OPACITY
    return Gaussians(**values)
