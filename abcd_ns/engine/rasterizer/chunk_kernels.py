"""Runs the chunk kernels eagerly or through `torch.compile`, and decides when compiling pays."""

import functools
import os
import shutil
import time
import warnings
from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor

from abcd_ns.engine.rasterizer import torch_kernels

CompilePolicy = Literal["auto", "always", "never"]
EAGER_SECONDS = 10.0
"""With "auto": time spent in eager kernels after which they are compiled. Compiling takes
tens of seconds at first, less from inductor's cache on disk: short runs are better off without."""


def has_cpp_compiler() -> bool:
    """Whether `torch.compile` finds a C++ compiler for the CPU."""
    return any(shutil.which(name) for name in (os.environ.get("CXX", "g++"), "g++", "clang++"))


@functools.cache
def _compiled(kernel: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """One compiled kernel for the whole process: all rasterizers share it."""
    return torch.compile(kernel)


class ChunkKernels:
    """`forward_chunk` and `backward_chunk`, eager or compiled."""

    def __init__(self, policy: CompilePolicy) -> None:
        self.policy = policy
        self.eager_seconds = 0.0

    def forward(
        self, params: Tensor, origins: Tensor, state: Tensor, window: Tensor | None, side: int
    ) -> Tensor:
        """See torch_kernels.forward_chunk."""
        return self._run(torch_kernels.forward_chunk, params, origins, state, window, side)

    def backward(
        self,
        params: Tensor,
        origins: Tensor,
        state: Tensor,
        upstream: Tensor,
        window: Tensor | None,
        side: int,
        absgrad: bool,
    ) -> Tensor:
        """See torch_kernels.backward_chunk."""
        return self._run(
            torch_kernels.backward_chunk, params, origins, state, upstream, window, side, absgrad
        )

    def compiles(self, params: Tensor) -> bool:
        if self.policy == "never":
            return False
        if self.policy == "always":
            return True
        suited = params.device.type == "cpu" and params.dtype == torch.float32
        return suited and self.eager_seconds > EAGER_SECONDS and has_cpp_compiler()

    def _run(self, kernel: Callable[..., Tensor], *args: Tensor | int | None) -> Tensor:
        params = args[0]
        if self.compiles(params):
            return self._run_compiled(kernel, *args)
        started = time.perf_counter()
        result = kernel(*args)
        self.eager_seconds += time.perf_counter() - started
        return result

    def _run_compiled(self, kernel: Callable[..., Tensor], *args: Tensor | int | None) -> Tensor:
        width = args[0].shape[-1]
        if width == 1:  # a size of one would be compiled a second time, as a constant
            args = tuple(torch.cat((x, x), dim=-1) if isinstance(x, Tensor) else x for x in args)
        for x in args:
            if isinstance(x, Tensor):
                torch._dynamo.mark_dynamic(x, x.ndim - 1)
        try:
            return _compiled(kernel)(*args)[..., :width]
        except (RuntimeError, OSError, ImportError) as error:
            warnings.warn(f"torch.compile failed, so the torch rasterizer stays slow: {error}", stacklevel=2)
            self.policy = "never"
            return kernel(*args)[..., :width]
