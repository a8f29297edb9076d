"""The warm-up: as many Gaussians as the memory of one visit holds, all over the scene, trained at once.

Blocks that begin among neighbours which are still blobs learn little from them. A coarse model fits where one
block fits, needs no layers, and takes little of the time. The remaining Gaussians are deferred: each is
unseen in its block until that is visited, so that neighbours look to each other as they were trained to look.
"""

import math
from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor

from abcd_ns.engine.gaussians.block_state import BlockState, Packed
from abcd_ns.engine.gaussians.initialize import PointCloud, split_off
from abcd_ns.engine.space.tree import BlockTree
from abcd_ns.engine.store.special_blocks import DEFERRED, BlockName
from abcd_ns.engine.types import Gaussians

REVEALED_OPACITY = 0.02  # of deferred Gaussians, once they are seen: enough to learn, too little to spoil
REVEALED_SCALE = 0.5  # their size, as a share of the distance to their neighbours


def defer(points: BlockState) -> BlockState:
    """Deferred points as they join the coarse model: small, faint, unseen until their block is visited."""
    old = points.gaussians
    faint = torch.full_like(old.opacities, math.log(REVEALED_OPACITY / (1 - REVEALED_OPACITY)))
    small = replace(old, opacities=faint, scales=old.scales + math.log(REVEALED_SCALE))
    return replace(points, gaussians=small, deferred=torch.ones_like(points.deferred))


def split_by_block(state: BlockState, owner: Tensor) -> dict[int, BlockState]:
    """By block, the rows that `owner` [n] gives it; the clocks stay those of `state`."""
    return {block: state[owner == block] for block in owner.unique().tolist()}


def by_block(tree: BlockTree, start: Gaussians | PointCloud) -> Iterator[tuple[int, BlockState]]:
    """Each block with its part of what a scene begins with, nothing of it trained; one is made at a time."""
    owner = tree.assign(start.means)
    sizes, order = owner.bincount(minlength=tree.num_blocks).tolist(), owner.argsort(stable=True)
    del owner
    for block, rows in enumerate(order.split(sizes)):
        part = start[rows]
        yield block, BlockState.fresh(part if isinstance(part, Gaussians) else part.gaussians())


def stored_blocks(
    tree: BlockTree, start: Gaussians | PointCloud, room: int | None = None, seed: int = 0
) -> Iterator[tuple[BlockName, Packed]]:
    """The first content of a store: `start` parted by `tree`, nothing trained yet; one block at a time. With
    a warm-up, `start` is points, of which those beyond the coarse model's `room` are deferred."""
    if room is not None:
        start, deferred = split_off(start, room, seed)
        yield DEFERRED, pack_points(deferred)
        del deferred
    for block, state in by_block(tree, start):
        yield block, state.packed()


def pack_points(points: PointCloud) -> Packed:
    """Deferred points, for the store."""
    return Packed(points.tensors, {"sh_degree": points.sh_degree, "flat": points.flat})
