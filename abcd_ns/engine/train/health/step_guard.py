"""Has an accelerator skip a step whose gradients are no numbers, while the host knows of nothing."""

import math
from collections.abc import Mapping

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from abcd_ns.engine.gaussians.adam import Adam


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
        """1 for each round of steps that was skipped, 0 for the others; whoever reads it empties it."""

    @property
    def works(self) -> bool:
        """Whether all optimizers can be told."""
        return all(optimizer.defaults.get("fused") for optimizer in self._optimizers.values())

    def tell(self, optimizer: torch.optim.Optimizer, skips: bool) -> None:
        """Call before it steps. The gradients of all are looked at when the first of them does.

        Args:
            skips: whether they do nothing if a gradient is no number.
        """
        if not self._told or any(told is optimizer for told in self._told):
            self._told, self._found = [], None
            self._begin(self._are_numbers() if skips else None)
        self._told.append(optimizer)
        optimizer.found_inf = self._found

    @torch.no_grad()
    def _begin(self, sound: Bool[Tensor, ""] | None) -> None:
        """A round of steps."""
        if sound is not None:
            self._found = torch.logical_not(sound, out=torch.empty((), device=sound.device))
            self.found.append(self._found)
        count = None
        for optimizer in self._optimizers.values():
            if isinstance(optimizer, Adam):
                optimizer.counts = False
                for state in optimizer.state.values():
                    count = state["step"] if count is None else count
                    state["step"] = count
        if count is not None:
            count.add_(1 if sound is None else sound)

    @torch.no_grad()
    def _are_numbers(self) -> Bool[Tensor, ""]:
        live = [p for o in self._optimizers.values() for p in o.param_groups[0]["params"]]
        gradients = [p.grad for p in live if p.grad is not None and p.grad.numel()]
        if not gradients:
            return torch.ones((), dtype=torch.bool, device=live[0].device)
        # An overflow of the squares counts, as it would in Adam's second moment.
        return torch.stack(torch._foreach_norm(gradients)).sum() < math.inf
