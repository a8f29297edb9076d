"""Triton's kernels, and the question whether they compile here."""

import warnings
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

try:
    from abcd_ns.engine.render.cuda import between as _between
    from abcd_ns.engine.render.cuda import by_gaussian as _by_gaussian
    from abcd_ns.engine.render.cuda import photometric as _loss
    from abcd_ns.engine.render.cuda import windowed as _windowed
except ImportError:  # Triton comes with torch for Linux
    _between = _loss = _by_gaussian = _windowed = None


class Fused:
    """A function of CUDA's kernels, until they turn out not to compile here.

    Args:
        name: of what they compute.
    """

    def __init__(self, name: str, function: Callable[..., Any] | None) -> None:
        self._name, self._function, self._ran = name, function, False

    @property
    def runs(self) -> bool:
        """Whether they have run here, and every call since."""
        return self._ran

    def __call__(self, first: Tensor, *rest: Any) -> Any:
        """What the function gives for these; None where it has to be found otherwise.

        Args:
            first: is where all are.
        """
        if self._function is None or not first.is_cuda or first.dtype != torch.float32:
            return None
        try:
            with torch.cuda.device_of(first):  # which Triton takes to be the current one
                found = self._function(first, *rest)
        except Exception as error:
            if self._ran or _is_of_the_device(error):
                raise
            warnings.warn(f"{self._name} runs uncompiled, so steps take longer: {error}", stacklevel=2)
            self._function = None
            return None
        self._ran = True
        return found


def _is_of_the_device(error: Exception) -> bool:
    """Whether it is no fault of the compiler's: memory is full, or a kernel failed."""
    full, failed = torch.cuda.OutOfMemoryError, getattr(torch, "AcceleratorError", ())
    return isinstance(error, (full, *([failed] if failed else []))) or "CUDA error" in str(error)


photometric = Fused("The loss", _loss and _loss.photometric)
shade = Fused("The colours", _by_gaussian and _by_gaussian.shade)
skips = Fused("The look at gradients", _by_gaussian and _by_gaussian.skips)
between = Fused("Compositing", _between and _between.between)
windowed = Fused("The windows", _windowed and _windowed.windowed)
