"""What the package's Triton kernels compute, in torch: their oracles, and what a simulated device runs."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from torch import Tensor

from abcd_ns.engine.kernels.photometric import photometric_sums
from abcd_ns.engine.render.cuda import fused
from tests.reference import simulated_device


def photometric(rendered: Tensor, photo: Tensor, by_pixel: float, by_window: float) -> tuple[Tensor, Tensor]:
    """The loss, and its gradient by `rendered`."""
    weights = rendered.new_tensor([by_pixel, by_window])
    planes = (image.permute(2, 0, 1).contiguous() for image in (rendered, photo))
    sums, gradient = photometric_sums(*planes, weights)
    return sums @ weights, gradient.permute(1, 2, 0).contiguous()


def statistics(
    gradient: Tensor,
    radii: Tensor,
    weights: Tensor,
    sums: Sequence[Tensor],
    scale: tuple[float, float],
    passes: float,
) -> Tensor:
    """The four sums, [4, n]."""
    norms = (gradient * gradient.new_tensor(scale)).norm(dim=-1)
    seen = (radii > 0) & norms.isfinite()
    more = norms.masked_fill(~seen, 0.0).sum(0), seen.sum(0), weights.sum(0).nan_to_num(0.0, 0.0, 0.0), passes
    return torch.stack([before + added for before, added in zip(sums, more, strict=True)])


TWINS = {photometric: 5, statistics: 1}
"""Their launches; one of the loss' fills the sum with zeros."""


def _on_device(twin: Callable[..., Any], launches: int) -> Callable[..., Any]:
    def run(*given: Any) -> Any:
        tensors = simulated_device._tensors(given)
        if not any(isinstance(x, simulated_device.OnDevice) for x in tensors):
            return None

        def compute(*values: Tensor) -> Any:
            rest = iter(values)
            return twin(*simulated_device._map(lambda _: next(rest), given))

        simulated_device._counts.launches += launches - 1
        return simulated_device.kernel(compute, *tensors)

    return run


@contextmanager
def lent_triton() -> Iterator[None]:
    """Within, the simulated device has the package's kernels."""
    with pytest.MonkeyPatch.context() as patch:
        for twin, launches in TWINS.items():
            patch.setattr(fused, twin.__name__, _on_device(twin, launches))
        yield
