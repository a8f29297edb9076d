"""Kernels of a simulated device that have a gradient; gsplat's signatures for what stands in for them."""

import functools
import inspect
from collections.abc import Callable
from typing import Any

import torch
from gsplat.cuda import _wrapper
from torch import Tensor

from tests.reference.simulated_device import kernel

STAND_INS: dict[str, Callable] = {}
"""By gsplat's names for them."""


class Differentiable(torch.autograd.Function):
    """A kernel, and another for its gradient: torch's own of the same computation, which is done again."""

    @staticmethod
    def forward(ctx: Any, compute: Callable[..., Any], *tensors: Tensor) -> Any:
        ctx.compute = compute
        ctx.save_for_backward(*tensors)
        results = tuple(kernel(compute, *tensors))
        whole = [x for x in results if not x.is_floating_point()]
        ctx.mark_non_differentiable(*whole)
        return results

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor | None) -> Any:
        inputs, wanted = ctx.saved_tensors, ctx.needs_input_grad[1:]
        given = [g for g in upstream if g is not None and g.is_floating_point()]

        def gradient(*tensors: Tensor) -> list[Tensor]:
            leaves = [x.detach().requires_grad_(w) for x, w in zip(tensors, wanted, strict=False)]
            with torch.enable_grad():
                results = [x for x in ctx.compute(*leaves) if x.is_floating_point()]
            asked = [x for x in leaves if x.requires_grad]
            if not any(x.requires_grad for x in results):  # as colours of degree 0 by directions
                return [torch.zeros_like(x) for x in asked]
            return torch.autograd.grad(results, asked, tensors[len(leaves) :], materialize_grads=True)

        found = iter(kernel(gradient, *inputs, *given))
        return None, *(next(found) if w else None for w in wanted)


def stands_in(**fixed: Any) -> Callable[[Callable], Callable]:
    """Give a function the signature of gsplat's of the same name.

    Args:
        fixed: arguments that the function does not take, and the only value of each that it stands in for.
    """

    def decorate(function: Callable) -> Callable:
        signature = inspect.signature(getattr(_wrapper, function.__name__))

        @functools.wraps(function)
        def call(*args: Any, **options: Any) -> Any:
            bound = signature.bind(*args, **options)
            bound.apply_defaults()
            given = dict(bound.arguments)
            assert {name: given.pop(name) for name in fixed} == fixed
            return function(**given)

        STAND_INS[function.__name__] = call
        return call

    return decorate
