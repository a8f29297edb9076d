"""Triton kernels by Gaussian: what is composited, and which steps are skipped."""

from collections.abc import Sequence

import torch
import triton
import triton.language as tl
from jaxtyping import Bool, Float
from torch import Tensor

BLOCK = 256


@triton.jit(do_not_specialize=("n",))
def _shade(colors_ptr, depths_ptr, features_ptr, dark_ptr, n, HAS_DEPTHS: tl.constexpr, BLOCK: tl.constexpr):
    """[n 4]: colours plus 0.5, 0 or more, and a depth; [n 3]: which would be less."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = at < n
    for channel in tl.static_range(3):
        color = tl.load(colors_ptr + 3 * at + channel, mask=mask, other=0.0) + 0.5
        tl.store(dark_ptr + 3 * at + channel, color < 0, mask=mask)
        tl.store(features_ptr + 4 * at + channel, tl.where(color < 0, 0.0, color), mask=mask)
    depth = tl.zeros((BLOCK,), tl.float32)
    if HAS_DEPTHS:
        depth = tl.load(depths_ptr + at, mask=mask, other=0.0)
    tl.store(features_ptr + 4 * at + 3, depth, mask=mask)


def shade(
    colors: Float[Tensor, "c n 3"], depths: Float[Tensor, "c n"] | None
) -> tuple[Float[Tensor, "c n 4"], Bool[Tensor, "c n 3"]]:
    """What is composited: colours plus 0.5, at least 0, and depths or zeros; and which colours are less."""
    colors, n = colors.contiguous(), colors[..., 0].numel()
    features = colors.new_empty((*colors.shape[:-1], 4))
    dark = colors.new_empty(colors.shape, dtype=torch.bool)
    given = colors if depths is None else depths.contiguous()
    if n:
        grid = (triton.cdiv(n, BLOCK),)
        _shade[grid](colors, given, features, dark, n, HAS_DEPTHS=depths is not None, BLOCK=BLOCK)
    return features, dark


NORMS = tuple(f"{name}_ptr" for name in "abcdef")


@triton.jit(do_not_specialize=NORMS)
def _skips(a_ptr, b_ptr, c_ptr, d_ptr, e_ptr, f_ptr, count_ptr, skips_ptr):
    """1 if any of six norms is no number, else 0; the count goes up by the other one."""
    norms = tl.load(a_ptr) + tl.load(b_ptr) + tl.load(c_ptr)
    norms += tl.load(d_ptr) + tl.load(e_ptr) + tl.load(f_ptr)
    sound = tl.where(norms < float("inf"), 1.0, 0.0)
    tl.store(skips_ptr, 1.0 - sound)
    tl.store(count_ptr, tl.load(count_ptr) + sound)


def skips(count: Float[Tensor, ""], norms: Sequence[Float[Tensor, ""]]) -> Float[Tensor, ""]:
    """Whether a step is to be skipped, 1 or 0, since any of up to six norms is no number; else it counts."""
    found = count.new_empty(())
    _skips[(1,)](*norms, *[norms[0]] * (len(NORMS) - len(norms)), count, found)
    return found
