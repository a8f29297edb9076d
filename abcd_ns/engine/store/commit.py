"""Where the Gaussians of a visit are stored, on the CPU: in their block, or pending for another."""

from collections.abc import Iterable
from dataclasses import replace

import torch
from torch import Tensor

from abcd_ns.engine.gaussians.block_state import BlockState, Clocks, Packed, join
from abcd_ns.engine.gaussians.initialize import PointCloud
from abcd_ns.engine.store.coarse_model import by_block, defer, pack_points, split_by_block
from abcd_ns.engine.store.scene import StoredScene, VisitScene
from abcd_ns.engine.store.special_blocks import ACTIVE, DEFERRED, PENDING, WHOLE, BlockName


def state_for_visit(scene: VisitScene, block: BlockName, saved: bool = False) -> BlockState:
    """What is attached when a visit to `block`, or with WHOLE the warm-up, begins, or resumes if `saved`."""
    if saved:
        state = scene.state(ACTIVE)
    else:
        state = join([with_pending(scene, number) for number in _blocks(scene, block)])
    return replace(state, deferred=None)


def rows_for_visit(scene: VisitScene, block: BlockName, saved: bool = False) -> int:
    """Rows of `state_for_visit`, without reading them."""
    if saved:
        return scene.rows(ACTIVE)
    return sum(scene.rows(number) + len(scene.pending_for(number) or ()) for number in _blocks(scene, block))


def _blocks(scene: VisitScene, block: BlockName) -> range:
    return range(scene.tree.num_blocks) if block == WHOLE else range(block, block + 1)


def with_pending(scene: VisitScene, block: int) -> BlockState:
    """A stored block, joined by its pending migrants."""
    state, migrants = scene.state(block), scene.pending_for(block)
    return state if migrants is None else join([state, migrants])


def commit(
    scene: StoredScene, block: BlockName, state: BlockState, migrate: bool = True, taken: int | None = None
) -> dict[BlockName, BlockState | Packed]:
    """What changes when `block`, or with WHOLE the coarse model of all, has been trained.

    Args:
        state: on the CPU.
        migrate: False drops the Gaussians that left their cell.
        taken: of those that wait for the block, so many of the first were in its visit, and the others came
            since; None for all.
    """
    if block == WHOLE:
        return commit_coarse_model(scene, state)
    inside = _owner(scene, state) == block
    left = state[~inside] if migrate else state.nobody
    if taken is not None and (migrants := scene.pending_for(block)) is not None:
        left = join([left, migrants[taken:]])
    return {block: state[inside], **pending_without(scene, block, left)}


def pending_without(
    scene: StoredScene, block: int, arrivals: BlockState | None = None
) -> dict[BlockName, BlockState]:
    """The pending migrants without those of a block and with arrivals, if that changes them."""
    parts = [arrivals] if arrivals else []
    if not parts and scene.pending_for(block) is None:
        return {}
    if scene.pending is not None:
        parts.insert(0, without(scene, scene.pending, [block]))
    return {PENDING: replace(join(parts), clocks=Clocks())}


def without(scene: StoredScene, state: BlockState, blocks: Iterable[int]) -> BlockState:
    """Those of a state that lie in none of these blocks."""
    return state[~torch.isin(_owner(scene, state), torch.tensor(sorted(blocks)))]


def commit_coarse_model(scene: StoredScene, state: BlockState) -> dict[BlockName, BlockState | Packed]:
    """Every block with its part of the coarse model and of the deferred points, of which none are left."""
    tensors, meta = scene.table(DEFERRED)
    deferred = PointCloud(**tensors, **meta)
    trained = split_by_block(state, _owner(scene, state))
    nobody = replace(BlockState.fresh(deferred[:0].gaussians()), clocks=state.clocks)
    committed = {
        block: join([trained.pop(block, nobody), defer(arrivals)])
        for block, arrivals in by_block(scene.tree, deferred)
    }
    return {**committed, DEFERRED: pack_points(deferred[:0])}


def _owner(scene: StoredScene, state: BlockState) -> Tensor:
    return scene.tree.assign(state.gaussians.means)
