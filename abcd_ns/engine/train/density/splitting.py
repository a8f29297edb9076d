"""Blocks that outgrow what the device holds are cut in two when they are persisted. After growth the scene is
cut anew, as pruning has left them half empty."""

from dataclasses import replace

from abcd_ns.engine.gaussians.block_state import BlockState, Clocks, join
from abcd_ns.engine.space.partition import best_split, build_kd
from abcd_ns.engine.space.tree import BlockTree
from abcd_ns.engine.store.coarse_model import split_by_block
from abcd_ns.engine.store.commit import with_pending, without
from abcd_ns.engine.store.scene import StoredScene
from abcd_ns.engine.store.special_blocks import ACTIVE, PENDING, BlockName
from abcd_ns.engine.train.recipe import Limits
from abcd_ns.engine.train.run_state import RunState


def split_full(
    tree: BlockTree, updates: dict[BlockName, BlockState], limits: Limits
) -> tuple[BlockTree, dict[BlockName, BlockState], dict[int, int]]:
    """Cut each block with more than FULL of its limit in equal halves, and those again if need be.

    Both parts keep the block's clocks. Gaussians that coincide stay together, however many they are.

    Args:
        updates: what is about to be persisted; what has a special name is not cut.

    Returns:
        The tree with the cuts, everything to persist, and of each new block the one that it was part of.
    """
    parents: dict[int, int] = {}
    waiting = sorted(block for block in updates if isinstance(block, int))
    updates = dict(updates)
    while waiting:
        block = waiting.pop(0)
        state = updates[block]
        if not limits.is_full(len(state), tree.num_blocks):
            continue
        means = state.gaussians.means
        new, cut = tree.num_blocks, tree.split(block, *best_split(means, tree.cell(block)))
        leaves = cut.assign(means) == new
        if bool(leaves.all()) or not bool(leaves.any()):
            continue
        tree, parents[new] = cut, block
        updates |= {block: state[~leaves], new: state[leaves]}
        waiting += [block, new]
    return tree, updates, parents


def _with_full(
    scene: StoredScene, updates: dict[BlockName, BlockState], limits: Limits, busy: set[int]
) -> dict[BlockName, BlockState]:
    """The updates, and blocks that pending migrants make full, but for the busy ones, in training."""
    pending = updates.get(PENDING)
    if not limits.block_limit or pending is None:
        return updates
    joined: dict[BlockName, BlockState] = {}
    for block, migrants in split_by_block(pending, scene.tree.assign(pending.gaussians.means)).items():
        # A block whose visit has just ended may have pending migrants, too: what came while it was out.
        rows = len(updates[block]) if block in updates else scene.rows(block)
        if block not in busy and limits.is_full(rows + len(migrants), scene.tree.num_blocks):
            joined[block] = join([updates[block] if block in updates else scene.state(block), migrants])
    return {**updates, **joined, PENDING: without(scene, pending, joined)} if joined else updates


def cut_full(
    scene: StoredScene, updates: dict[BlockName, BlockState], state: RunState, limits: Limits
) -> tuple[BlockTree, dict[BlockName, BlockState], dict[int, int]]:
    """As `split_full`, with pending migrants. Parts inherit what the run knows of the whole."""
    busy = {visit.geometry.block for visit in state.in_flight}
    tree, updates, parents = split_full(scene.tree, _with_full(scene, updates, limits, busy), limits)
    for new, parent in parents.items():
        state.inherit(new, parent)
    return tree, updates, parents


def cut_anew(scene: StoredScene, blocks: int) -> tuple[BlockTree, dict[BlockName, BlockState]]:
    """A tree of so many blocks with equal numbers of Gaussians, and everything to persist; blocks beyond them
    are empty. All get the clocks of the old block that was trained on the median number of views."""
    old = [with_pending(scene, block) for block in range(scene.tree.num_blocks)]
    clocks = sorted((state.clocks for state in old), key=lambda clocks: clocks.adam_views)[len(old) // 2]
    whole = replace(join(old), clocks=clocks)
    del old
    tree = build_kd(whole.gaussians.means, blocks)
    parts = split_by_block(whole, tree.assign(whole.gaussians.means))
    updates: dict[BlockName, BlockState] = {
        block: parts.get(block, whole.nobody) for block in range(scene.tree.num_blocks)
    }
    if scene.pending is not None:
        updates[PENDING] = replace(scene.pending.nobody, clocks=Clocks())
    return tree, updates


def end_joint(scene: StoredScene, state: RunState, limits: Limits) -> None:
    """Where a run resumes with smaller limits, the visit to a block that is the whole scene is over if it is
    too large now. Other blocks are cut when their visits begin."""
    active = state.active
    if active is None or not active.is_joint:
        return
    block = active.geometry.block
    if limits.is_full(scene.rows(ACTIVE) if active.saved else scene.count(block), blocks=1):
        found = scene.state(ACTIVE) if active.saved else None
        state.active = None
        scene.persist(scene.tree, {block: found, ACTIVE: found.nobody} if found else {}, state.to_json())
