"""Triton's kernels, and the question whether they compile here."""

import warnings
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

try:
    from abcd_ns.engine.render.cuda import between as _between
    from abcd_ns.engine.render.cuda import by_row as _by_row
    from abcd_ns.engine.render.cuda import photometric as _loss
except ImportError:  # Triton comes with torch for Linux
    _between = _by_row = _loss = None


class Fused:
    """A function of CUDA's kernels, until they turn out not to compile here; `name` is what they compute."""

    def __init__(self, name: str, function: Callable[..., Any] | None) -> None:
        self._name, self._function = name, function
        self.runs = False
        """Whether they have run here, and every call since."""

    def __call__(self, first: Tensor, *rest: Any) -> Any:
        """What the function gives for these, which are all where `first` is; None where it has to be found
        otherwise."""
        if self._function is None or not first.is_cuda or first.dtype != torch.float32:
            return None
        try:
            with torch.cuda.device_of(first):  # which Triton takes to be the current one
                found = self._function(first, *rest)
        except Exception as error:
            if self.runs or _is_of_the_device(error):
                raise
            warnings.warn(f"{self._name} runs uncompiled, so steps take longer: {error}", stacklevel=2)
            self._function = None
            return None
        self.runs = True
        return found


def _is_of_the_device(error: Exception) -> bool:
    """Whether it is no fault of the compiler's: memory is full, or a kernel failed."""
    kinds = torch.cuda.OutOfMemoryError, getattr(torch, "AcceleratorError", ())
    return isinstance(error, kinds) or "CUDA error" in str(error)


photometric = Fused("The loss", _loss and _loss.photometric)
shade = Fused("The colours", _by_row and _by_row.shade)
skips = Fused("The look at gradients", _by_row and _by_row.skips)
between = Fused("Compositing", _between and _between.between)
windowed = Fused("The windows", _by_row and _by_row.windowed)
