"""Has an accelerator skip a step whose gradients are no numbers, while the host knows of nothing."""

import math
from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.gaussians.adam import Adam
from abcd_ns.engine.render.cuda import fused


class StepGuard:
    """Tells fused Adams, by `found_inf` as a GradScaler does, that they are to do nothing.

    Those that are `Adam` share one step count, which is advanced here: one kernel for all of them.

    Args:
        optimizers: that step one after the other, in any order.
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
        """Call before it steps. The gradients of all are looked at when the first of them does.

        Args:
            skips: whether they do nothing if a gradient is no number.
        """
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
