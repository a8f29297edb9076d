"""What density control adds up for each Gaussian, in one Triton kernel."""

from collections.abc import Sequence

import triton
import triton.language as tl
from jaxtyping import Float, Int
from torch import Tensor

BLOCK = 256


@triton.jit(do_not_specialize=("n", "by_x", "by_y", "passes"))
def _statistics(
    gradient_ptr, radii_ptr, weights_ptr, norms_ptr, seen_ptr, weight_ptr, passes_ptr, out_ptr,
    n, by_x, by_y, passes, VIEWS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """[4 n]: the four sums so far, and what VIEWS drawings add to each."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = at < n
    norms = tl.load(norms_ptr + at, mask=mask, other=0.0)
    seen = tl.load(seen_ptr + at, mask=mask, other=0.0)
    weight = tl.zeros((BLOCK,), tl.float32)
    for view in range(VIEWS):
        row = view * n + at
        x = tl.load(gradient_ptr + 2 * row, mask=mask, other=0.0) * by_x
        y = tl.load(gradient_ptr + 2 * row + 1, mask=mask, other=0.0) * by_y
        norm = tl.sqrt(x * x + y * y)
        # An accelerator may have skipped the step that these are of; no comparison holds for NaN.
        counts = (tl.load(radii_ptr + row, mask=mask, other=0) > 0) & (norm < float("inf"))
        norms += tl.where(counts, norm, 0.0)
        seen += tl.where(counts, 1.0, 0.0)
        weight += tl.load(weights_ptr + row, mask=mask, other=0.0)
    weight = tl.where(tl.abs(weight) < float("inf"), weight, 0.0)
    tl.store(out_ptr + at, norms, mask=mask)
    tl.store(out_ptr + n + at, seen, mask=mask)
    tl.store(out_ptr + 2 * n + at, tl.load(weight_ptr + at, mask=mask, other=0.0) + weight, mask=mask)
    tl.store(out_ptr + 3 * n + at, tl.load(passes_ptr + at, mask=mask, other=0.0) + passes, mask=mask)


def statistics(
    gradient: Float[Tensor, "v n 2"],
    radii: Int[Tensor, "v n"],
    weights: Float[Tensor, "v n"],
    sums: Sequence[Float[Tensor, "n"]],
    scale: tuple[float, float],
    passes: float,
) -> Float[Tensor, "4 n"]:
    """The sums after v more drawings: of gradients' norms, of how many there were, of weights and of passes.

    Args:
        gradient: by the projected means; those that are no numbers count for nothing.
        radii: 0 where nothing was drawn.
        weights: in each picture; a sum that is no number counts for nothing.
        sums: the four before.
        scale: of the gradients, along both axes.
        passes: to add for each.
    """
    views, n = radii.shape
    out = gradient.new_empty((4, n))
    inputs = [value.contiguous() for value in (gradient, radii, weights, *sums)]
    if n:
        grid = (triton.cdiv(n, BLOCK),)
        _statistics[grid](*inputs, out, n, *scale, passes, VIEWS=views, BLOCK=BLOCK)
    return out
