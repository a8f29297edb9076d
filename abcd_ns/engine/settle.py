"""Where the Gaussians of a visit come to rest: each in the block that holds its mean."""

from dataclasses import replace

from torch import Tensor

from abcd_ns.engine.block_state import BlockState
from abcd_ns.engine.scaffold import LIVE, RESERVE, WHOLE, join, part, put_to_wait, revealed
from abcd_ns.engine.scene import StoredScene


def at_rest(scene: StoredScene, block: int, saved: bool = False) -> BlockState:
    """What is attached when a visit to `block`, or with WHOLE the warm-up, begins or goes on.

    Args:
        saved: the visit goes on where a save found it.
    """
    state = join([_at_rest(scene, number) for number in _numbers(scene, block, saved)])
    return replace(state, gaussians=revealed(state.gaussians))


def count_at_rest(scene: StoredScene, block: int, saved: bool = False) -> int:
    """Rows of `at_rest`, without reading them."""
    return sum(scene.store.counts(number) for number in _numbers(scene, block, saved))


def _numbers(scene: StoredScene, block: int, saved: bool) -> list[int]:
    if saved:
        return [LIVE]
    return list(range(scene.tree.num_blocks)) if block == WHOLE else [block]


def settle(scene: StoredScene, block: int, state: BlockState, migrate: bool = True) -> dict[int, BlockState]:
    """The blocks that change when `block`, or with WHOLE the scaffold of all, has been trained.

    Args:
        migrate: False drops the Gaussians that left their cell.
    """
    if block == WHOLE:
        return settle_scaffold(scene, state)
    if not migrate:
        return {block: state[_owner(scene, state) == block]}
    return settle_block(scene, block, state)


def settle_block(scene: StoredScene, block: int, state: BlockState) -> dict[int, BlockState]:
    """The blocks that change when `block` has been trained: it, and those that its Gaussians moved to."""
    parts = part(state, _owner(scene, state))
    settled = {block: parts.get(block, state[:0])}
    for target, arrivals in parts.items():
        if target != block:
            settled[target] = _at_rest(scene, target).to(state.gaussians.device).joined_by(arrivals)
    return settled


def settle_scaffold(scene: StoredScene, state: BlockState) -> dict[int, BlockState]:
    """Every block with its part of the scaffold and of the reserve, which is empty from then on.

    Raises:
        KeyError: the store holds no reserve.
    """
    waiting = _at_rest(scene, RESERVE).to(state.gaussians.device)
    trained, arrivals = part(state, _owner(scene, state)), part(put_to_wait(waiting), _owner(scene, waiting))
    nobody = replace(waiting[:0], clocks=state.clocks)
    settled = {
        block: trained.get(block, nobody).joined_by(arrivals.get(block, nobody))
        for block in range(scene.tree.num_blocks)
    }
    return {**settled, RESERVE: waiting[:0]}


def has_scaffold(scene: StoredScene) -> bool:
    """Whether the scene begins with a warm-up; the reserve may be empty."""
    return RESERVE in scene.store.blocks


def _at_rest(scene: StoredScene, block: int) -> BlockState:
    return BlockState.from_tensors(*scene.store.load(block))


def _owner(scene: StoredScene, state: BlockState) -> Tensor:
    return scene.tree.assign(state.gaussians.means.cpu()).to(state.gaussians.device)
