"""Triton kernels: what is composited of Gaussians, which steps are skipped, which pairs lie in windows."""

from collections.abc import Sequence

import torch
import triton
import triton.language as tl
from jaxtyping import Bool, Float, Int, Int64
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


@triton.jit(do_not_specialize=("count", "always", "bits", "tiles"))
def _inside(
    isect_ids_ptr, flatten_ids_ptr, near_ptr, far_ptr, keep_ptr,
    count, always, bits, tiles, BLOCK: tl.constexpr,
):  # fmt: skip
    """[q]: 1 where a pair is within its tile's window, or its owner is one of the first, else 0."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = at < count
    key = tl.load(isect_ids_ptr + at, mask=mask, other=0)
    place = key >> 32
    tile = (place >> bits) * tiles + (place & ((1 << bits) - 1))
    z = (key & 0xFFFFFFFF).to(tl.int32).to(tl.float32, bitcast=True)
    inside = z >= tl.load(near_ptr + tile, mask=mask, other=0.0)
    inside = inside & (z < tl.load(far_ptr + tile, mask=mask, other=0.0))
    inside = inside | (tl.load(flatten_ids_ptr + at, mask=mask, other=0) < always)
    tl.store(keep_ptr + at, inside.to(tl.int32), mask=mask)


@triton.jit(do_not_specialize=("count", "last_key"))
def _move_up(
    isect_ids_ptr, flatten_ids_ptr, keep_ptr, kept_ptr, new_isect_ids_ptr, new_flatten_ids_ptr,
    count, last_key, BLOCK: tl.constexpr,
):  # fmt: skip
    """[q] each: what is kept, in order; then `last_key`, and 0 for the owner."""
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = at < count
    keep = tl.load(keep_ptr + at, mask=mask, other=0) != 0
    before = tl.load(kept_ptr + at, mask=mask, other=0)
    place = tl.where(keep, before - 1, tl.load(kept_ptr + count - 1) + at - before)
    key = tl.load(isect_ids_ptr + at, mask=mask, other=0)
    owner = tl.load(flatten_ids_ptr + at, mask=mask, other=0)
    tl.store(new_isect_ids_ptr + place, tl.where(keep, key, last_key), mask=mask)
    tl.store(new_flatten_ids_ptr + place, tl.where(keep, owner, 0), mask=mask)


def windowed(
    near: Float[Tensor, "t"],
    far: Float[Tensor, "t"],
    isect_ids: Int64[Tensor, "q"],
    flatten_ids: Int[Tensor, "q"],
    always: int,
    bits: int,
    tiles: int,
    last_key: int,
) -> tuple[Int64[Tensor, "q"], Int[Tensor, "q"]]:
    """Keys and owners of the pairs within their tile's window; the others are at the end, with `last_key`.

    Args:
        near, far: camera z, by tile of all cameras.
        isect_ids: camera, tile (of so many `bits`), bits of a positive depth.
        always: owners below that are within.
        tiles: of each camera.
    """
    count = len(isect_ids)
    if count == 0:
        return isect_ids, flatten_ids
    keep, grid = torch.empty_like(flatten_ids), (triton.cdiv(count, BLOCK),)
    _inside[grid](isect_ids, flatten_ids, near, far, keep, count, always, bits, tiles, BLOCK=BLOCK)
    found = torch.empty_like(isect_ids), torch.empty_like(flatten_ids)
    _move_up[grid](isect_ids, flatten_ids, keep, keep.cumsum(0), *found, count, last_key, BLOCK=BLOCK)
    return found
