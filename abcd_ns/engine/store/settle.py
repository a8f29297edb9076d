"""Where the Gaussians of a visit come to rest, on the CPU: in their block, or in the inbox of another."""

from collections.abc import Iterable
from dataclasses import replace

import torch
from torch import Tensor

from abcd_ns.engine.gaussians.block_state import BlockState, Clocks, join
from abcd_ns.engine.store.scaffold import put_to_wait, split_by_block
from abcd_ns.engine.store.scene import StoredScene, VisitScene
from abcd_ns.engine.store.special_blocks import INBOX, LIVE, RESERVE, WHOLE, BlockName


def state_for_visit(scene: VisitScene, block: BlockName, saved: bool = False) -> BlockState:
    """What is attached when a visit to `block`, or with WHOLE the warm-up, begins or goes on.

    Args:
        saved: the visit goes on where a save found it.
    """
    state = (
        scene.state(LIVE) if saved else join([with_mail(scene, number) for number in _blocks(scene, block)])
    )
    return replace(state, waits=None)


def rows_for_visit(scene: VisitScene, block: BlockName, saved: bool = False) -> int:
    """Rows of `state_for_visit`, without reading them."""
    if saved:
        return scene.rows(LIVE)
    return sum(scene.rows(number) + len(scene.mail(number) or ()) for number in _blocks(scene, block))


def _blocks(scene: VisitScene, block: BlockName) -> range:
    return range(scene.tree.num_blocks) if block == WHOLE else range(block, block + 1)


def with_mail(scene: VisitScene, block: int) -> BlockState:
    """A block at rest, joined by those that wait for its next visit."""
    state, mail = scene.state(block), scene.mail(block)
    return state if mail is None else join([state, mail])


def settle(
    scene: StoredScene, block: BlockName, state: BlockState, migrate: bool = True, taken: int | None = None
) -> dict[BlockName, BlockState]:
    """What changes when `block`, or with WHOLE the scaffold of all, has been trained.

    Args:
        state: on the CPU.
        migrate: False drops the Gaussians that left their cell.
        taken: of those that wait for the block, so many of the first were in its visit, and the others came
            since; None for all.
    """
    if block == WHOLE:
        return settle_scaffold(scene, state)
    inside = _owner(scene, state) == block
    left = state[~inside] if migrate else state.nobody
    if taken is not None and (mail := scene.mail(block)) is not None:
        left = join([left, mail[taken:]])
    return {block: state[inside], **inbox_without(scene, {block}, left)}


def inbox_without(
    scene: StoredScene, blocks: set[int], arrivals: BlockState | None = None
) -> dict[BlockName, BlockState]:
    """The inbox, under its name, without what waited for these blocks and with arrivals; nothing where that
    leaves it as it was."""
    inbox, taken = scene.inbox, any(scene.mail(block) is not None for block in blocks)
    come = [] if arrivals is None or not len(arrivals) else [arrivals]
    if not taken and not come:
        return {}
    if inbox is not None:
        come = [without(scene, inbox, blocks), *come]
    return {INBOX: replace(join(come), clocks=Clocks())}


def without(scene: StoredScene, state: BlockState, blocks: Iterable[int]) -> BlockState:
    """Those of a state that lie in none of these blocks."""
    return state[~torch.isin(_owner(scene, state), torch.tensor(sorted(blocks)))]


def settle_scaffold(scene: StoredScene, state: BlockState) -> dict[BlockName, BlockState]:
    """Every block with its part of the scaffold and of the reserve, which is empty from then on.

    Raises:
        KeyError: there is no reserve.
    """
    waiting = scene.state(RESERVE)
    trained = split_by_block(state, _owner(scene, state))
    arrivals = split_by_block(put_to_wait(waiting), _owner(scene, waiting))
    nobody = replace(waiting.nobody, clocks=state.clocks)
    settled = {
        block: join([trained.get(block, nobody), arrivals.get(block, nobody)])
        for block in range(scene.tree.num_blocks)
    }
    return {**settled, RESERVE: waiting.nobody}


def has_scaffold(scene: StoredScene) -> bool:
    """Whether the scene begins with a warm-up; the reserve may be empty."""
    return scene.has(RESERVE)


def _owner(scene: StoredScene, state: BlockState) -> Tensor:
    return scene.tree.assign(state.gaussians.means)
