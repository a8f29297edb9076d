"""Blocks that outgrow what the device holds are cut in two where they come to rest."""

from abcd_ns.engine.block_state import BlockState
from abcd_ns.engine.blocks import BlockTree
from abcd_ns.engine.partition import best_split
from abcd_ns.engine.run_state import RunState
from abcd_ns.engine.scene import StoredScene

FULL = 0.75
"""Share of its limit over which a block is cut: the next visit needs room to grow."""


def split_full(
    tree: BlockTree, settled: dict[int, BlockState], limit: int, sole: int = 0
) -> tuple[BlockTree, dict[int, BlockState], dict[int, int]]:
    """Cut each block with more than FULL of `limit` Gaussians in equal halves, and those again if need be.

    Both parts keep the block's clocks. Gaussians that coincide stay together, however many they are.

    Args:
        settled: blocks that are about to be stored; numbers that are no block's are left alone.
        limit: 0 is none.
        sole: the limit of a block that is the whole scene; 0 is `limit`.

    Returns:
        The tree with the cuts, everything to be stored, and of each new block the one that it was part of.
    """
    parents: dict[int, int] = {}
    alone = tree.num_blocks == 1 and all(len(state) <= FULL * sole for state in settled.values())
    if not limit or alone:
        return tree, settled, parents
    waiting = sorted(block for block in settled if block < tree.num_blocks)
    settled = dict(settled)
    while waiting:
        block = waiting.pop(0)
        state = settled[block]
        if len(state) <= FULL * limit:
            continue
        means = state.gaussians.means.detach().cpu()
        new, cut = tree.num_blocks, tree.split(block, *best_split(means, tree.cell(block)))
        leaves = (cut.assign(means) == new).to(state.gaussians.device)
        if bool(leaves.all()) or not bool(leaves.any()):
            continue
        tree, parents[new] = cut, block
        settled |= {block: state[~leaves], new: state[leaves]}
        waiting += [block, new]
    return tree, settled, parents


def cut_at_rest(scene: StoredScene, state: RunState, limit: int, sole: int = 0) -> None:
    """Cut the blocks of a run that goes on with smaller limits than it had; nothing where all are in order.

    A block whose visit was under way is left for its end.

    Args:
        limit, sole: as of `split_full`.
    """
    for block in range(scene.tree.num_blocks) if limit else ():
        if scene.store.counts(block) <= FULL * limit or state.active is not None:
            continue
        large = {block: BlockState.from_tensors(*scene.store.load(block))}
        tree, parts, parents = split_full(scene.tree, large, limit, sole)
        if not parents:
            continue
        for new, parent in parents.items():
            state.inherit(new, parent)
        scene.rest(tree, {number: part.to_tensors() for number, part in parts.items()}, state.to_json())
