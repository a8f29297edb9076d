"""Chooses between the eager chunk kernels and the built ones."""

from typing import Literal

import torch
from torch import Tensor

from abcd_ns.engine.rasterizer import torch_kernels
from abcd_ns.engine.rasterizer.built_kernels import BuiltKernels, build_kernels, load_kernels

CompilePolicy = Literal["auto", "always", "never"]


class ChunkKernels:
    """`forward_chunk` and `backward_chunk`, eager or built ahead of time.

    Built kernels serve float32 on the CPU; everything else runs eagerly.

    Args:
        policy: "auto" takes built kernels where they are found and builds them when `warm_up` is called;
            "always" builds them now; "never" is eager.
    """

    def __init__(self, policy: CompilePolicy, side: int, chunk: int) -> None:
        self._policy, self._size = policy, (side, chunk)
        self._built: BuiltKernels | None = None
        if policy == "auto":
            self._built = load_kernels(side, chunk)
        elif policy == "always":
            self._built = build_kernels(side, chunk)

    @property
    def are_built(self) -> bool:
        """Whether float32 on the CPU runs fast."""
        return self._built is not None

    def warm_up(self) -> None:
        """Build the kernels, about a minute once per machine, unless the policy is "never"."""
        if self._policy != "never" and self._built is None:
            self._built = build_kernels(*self._size)

    def forward(self, params: Tensor, origins: Tensor, state: Tensor, window: Tensor | None) -> Tensor:
        """See torch_kernels.forward_chunk."""
        side = self._size[0]
        if not self._suits(params):
            return torch_kernels.forward_chunk(params, origins, state, window, side)
        width = params.shape[-1]
        args = _two_wide(params, origins, state, _window(window, state))
        return self._built.forward(*args)[..., :width]

    def backward(
        self,
        params: Tensor,
        origins: Tensor,
        state: Tensor,
        upstream: Tensor,
        window: Tensor | None,
        absgrad: bool,
    ) -> Tensor:
        """See torch_kernels.backward_chunk. Built kernels give the absolute gradients unasked."""
        side = self._size[0]
        if not self._suits(params):
            return torch_kernels.backward_chunk(params, origins, state, upstream, window, side, absgrad)
        width = params.shape[-1]
        args = _two_wide(params, origins, state, upstream, _window(window, state))
        sums = self._built.backward(*args)[..., :width]
        return sums if absgrad else sums[: torch_kernels.GRADIENTS]

    def _suits(self, params: Tensor) -> bool:
        return self._built is not None and params.device.type == "cpu" and params.dtype == torch.float32


def _window(window: Tensor | None, state: Tensor) -> Tensor:
    """Any window will do where there is none: every Gaussian's ALWAYS is 1."""
    return state.new_zeros((2, *state.shape[1:])) if window is None else window


def _two_wide(*tensors: Tensor) -> tuple[Tensor, ...]:
    """Built kernels take two tiles or more: a single one is drawn twice."""
    if tensors[0].shape[-1] > 1:
        return tensors
    return tuple(torch.cat((tensor, tensor), dim=-1) for tensor in tensors)
