"""Has an accelerator skip a step whose gradients are no numbers, while the host knows of nothing."""

from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor


class StepGuard:
    """Tells fused Adams, by `found_inf` as a GradScaler does, that they are to do nothing.

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

    def tell(self, optimizer: torch.optim.Optimizer) -> None:
        """Call before it steps. The gradients of all are looked at when the first of them does."""
        if not self._told or any(told is optimizer for told in self._told):
            self._told, self._found = [], self._look()
            self.found.append(self._found)
        self._told.append(optimizer)
        optimizer.found_inf = self._found

    def stop(self) -> None:
        """Let all of them step whatever their gradients are."""
        self._told = []
        for optimizer in self._optimizers.values():
            optimizer.found_inf = None

    @torch.no_grad()
    def _look(self) -> Float[Tensor, ""]:
        live = [p for o in self._optimizers.values() for p in o.param_groups[0]["params"]]
        gradients = [p.grad for p in live if p.grad is not None and p.grad.numel()]
        if not gradients:
            return torch.zeros((), device=live[0].device)
        # An overflow of the squares counts, as it would in Adam's second moment.
        norms = torch.stack(torch._foreach_norm(gradients))
        return (~norms.isfinite()).any().float()
