"""The warm-up: as many Gaussians as the memory of one visit holds, all over the scene, trained at once.

Blocks that begin among neighbours which are still blobs learn little from them, and each block's first
visits are spent on that. A coarse model is a coarse picture of everything that fits where one block fits,
needs no layers, and takes little of the time. The remaining Gaussians are deferred, then each in its block,
unseen until that is visited for the first time: neighbours look to each other as they were trained to look.
"""

import math
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from abcd_ns.engine.gaussians.block_state import BlockState
from abcd_ns.engine.gaussians.initialize import split_off
from abcd_ns.engine.space.tree import BlockTree
from abcd_ns.engine.store.special_blocks import DEFERRED, BlockName
from abcd_ns.engine.types import Gaussians

REVEALED_OPACITY = 0.02
"""Of a Gaussian of the deferred points, once it is seen: enough to be drawn and to learn, too little to spoil
what is there."""
REVEALED_SCALE = 0.5
"""Its size, as a share of the distance to its neighbours."""


def defer(points: BlockState) -> BlockState:
    """Deferred points as they join the coarse model: small, faint, unseen until their block is visited."""
    old = points.gaussians
    faint = torch.full_like(old.opacities, math.log(REVEALED_OPACITY / (1 - REVEALED_OPACITY)))
    small = replace(old, opacities=faint, scales=old.scales + math.log(REVEALED_SCALE))
    return replace(points, gaussians=small, deferred=torch.ones_like(points.deferred))


def split_by_block(state: BlockState, owner: Tensor) -> dict[int, BlockState]:
    """By block, the rows that `owner` [n] gives it; the clocks stay those of `state`."""
    return {block: state[owner == block] for block in owner.unique().tolist()}


def blocks_at_rest(
    tree: BlockTree, gaussians: Gaussians, room: int | None = None, seed: int = 0
) -> dict[BlockName, tuple[dict[str, Tensor], dict[str, Any]]]:
    """The first content of a store: `gaussians` parted by `tree`, nothing trained yet.

    Args:
        room: for Gaussians in the coarse model; others are deferred. None for no warm-up.
    """
    if room is None:
        at_rest = split_by_block(BlockState.fresh(gaussians), tree.assign(gaussians.means))
        nobody = BlockState.fresh(gaussians[:0])
        return {b: at_rest.get(b, nobody).packed() for b in range(tree.num_blocks)}
    coarse_model, deferred = split_off(gaussians, min(room, len(gaussians)), seed)
    points = BlockState.fresh(deferred).packed()
    return {**blocks_at_rest(tree, coarse_model), DEFERRED: points}
