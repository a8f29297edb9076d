"""torch's fused Adam, whose steps may be counted for several optimizers at once."""

from typing import Any

import torch


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
        names = ("lr", "weight_decay", "eps", "amsgrad", "maximize")
        options = {name: group[name] for name in names}
        options["beta1"], options["beta2"] = group["betas"]
        torch._fused_adam_(*parts, **options, grad_scale=None, found_inf=getattr(self, "found_inf", None))
