"""Sorted lists of (Gaussian, tile) pairs without those that lie outside of windows: two Triton kernels."""

import torch
import triton
import triton.language as tl
from jaxtyping import Float, Int, Int64
from torch import Tensor

BLOCK = 256


@triton.jit(do_not_specialize=("count", "always", "bits", "tiles"))
def _inside(
    isect_ids_ptr,
    flatten_ids_ptr,
    near_ptr,
    far_ptr,
    keep_ptr,
    count,
    always,
    bits,
    tiles,
    BLOCK: tl.constexpr,
):
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
    isect_ids_ptr,
    flatten_ids_ptr,
    keep_ptr,
    kept_ptr,
    new_isect_ids_ptr,
    new_flatten_ids_ptr,
    count,
    last_key,
    BLOCK: tl.constexpr,
):
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
    keep, new_isect_ids, new_flatten_ids = (
        torch.empty_like(flatten_ids),
        torch.empty_like(isect_ids),
        torch.empty_like(flatten_ids),
    )
    grid = (triton.cdiv(count, BLOCK),)
    _inside[grid](isect_ids, flatten_ids, near, far, keep, count, always, bits, tiles, BLOCK=BLOCK)
    kept = keep.cumsum(0)
    _move_up[grid](
        isect_ids, flatten_ids, keep, kept, new_isect_ids, new_flatten_ids, count, last_key, BLOCK=BLOCK
    )
    return new_isect_ids, new_flatten_ids
