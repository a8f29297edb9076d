"""Fused Adam: the native library's on a CPU, else torch's, whose steps may be counted for several at once."""

import math
from typing import Any

import torch

from abcd_ns.engine.kernels.native import address, library, suits


class Adam(torch.optim.Adam):
    """The same kernel and state. Each of torch's own launches two more kernels, to count its steps.

    Takes `fused=True` and one parameter group.
    """

    counts = True
    """Whether it counts its steps; if not, `state["step"]` is up to date when it steps."""

    @torch.no_grad()
    def step(self, closure: None = None) -> None:  # noqa: ARG002 - torch's signature
        """Update the parameters that have a gradient, unless `found_inf` is 1."""
        (group,) = self.param_groups
        parts: tuple[list[Any], ...] = ([], [], [], [], [], [])
        self._init_group(group, *parts)
        if not parts[0]:
            return
        if self.counts:
            torch._foreach_add_(parts[-1], 1)
        is_plain = not (group["weight_decay"] or group["amsgrad"] or group["maximize"])
        beta1, beta2 = group["betas"]
        if is_plain and suits(*parts[0], *parts[1]):
            for value, *others, count in zip(*parts[:4], parts[-1], strict=True):
                steps, eps = float(count), group["eps"]
                rates = group["lr"] / (1 - beta1**steps), beta1, beta2, math.sqrt(1 - beta2**steps), eps
                library().abcd_adam(value.numel(), *map(address, (value, *others)), *rates)
            return
        names = ("lr", "weight_decay", "eps", "amsgrad", "maximize")
        options = {name: group[name] for name in names} | {"beta1": beta1, "beta2": beta2}
        torch._fused_adam_(*parts, **options, grad_scale=None, found_inf=getattr(self, "found_inf", None))
