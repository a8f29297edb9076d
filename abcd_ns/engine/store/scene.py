"""Where the blocks of a scene are found: stored in RAM and on disk, one of them active in parameters."""

import itertools
import math
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from itertools import pairwise
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from abcd_ns.engine.gaussians.block_state import DRAWN, IS_DEFERRED, BlockState, Clocks, Packed
from abcd_ns.engine.gaussians.spherical_harmonics import count_parameters
from abcd_ns.engine.space.tree import BlockTree, Box
from abcd_ns.engine.space.visibility import bounds_of, united
from abcd_ns.engine.store import ParameterStore
from abcd_ns.engine.store.block_memory import BlockMemory
from abcd_ns.engine.store.coarse_model import split_by_block
from abcd_ns.engine.store.special_blocks import ACTIVE, PENDING, BlockName
from abcd_ns.engine.store.write_behind import Snapshot, WriteBehind
from abcd_ns.engine.types import Gaussians

Which = Callable[[Float[Tensor, "n 3"], Float[Tensor, "n 3"]], Bool[Tensor, "n"]]
"""Picks Gaussians by their means and scales."""


@runtime_checkable
class BlockScene(Protocol):
    """Gaussians by block."""

    tree: BlockTree

    def gaussians(self, block: int) -> Gaussians:
        """The block's Gaussians, without a graph, wherever they are kept."""

    def count(self, block: int) -> int:
        """How many Gaussians the block has."""
        return len(self.gaussians(block))

    def bounds(self, block: int) -> Box | None:
        """`bounds_of` the block's Gaussians."""

    def drawn(self, block: int, device: torch.device | str, which: Which | None = None) -> Gaussians:
        """As `gaussians`, on a device; of them those that are picked, if all are not wanted."""
        return _picked(self.gaussians(block), which).to(device)


@runtime_checkable
class VisitScene(BlockScene, Protocol):
    """What a visit needs to know of the scene that its block belongs to."""

    def state(self, name: BlockName) -> BlockState:
        """A stored block, whole, without its pending migrants."""

    def pending_for(self, block: int) -> BlockState | None:
        """The Gaussians that wait for the next visit to a block; their clocks mean nothing."""

    def rows(self, name: BlockName) -> int:
        """Gaussians stored under a name, the pending migrants of a block left out; nothing is read."""

    def stored_with_pending(self, block: int) -> Gaussians:
        """The block as a visit will find it, whatever is active."""

    def set_active(self, block: int | None, gaussians: Callable[[], Gaussians], sh_degree: int = 0) -> None:
        """From now on `block`, or with None the whole scene, is what `gaussians` returns, not what is stored.
        `sh_degree` is the scene's; what is active may have fewer harmonics by now."""


class MemoryScene(BlockScene):
    """A scene that is one list of Gaussians in memory, parted by a tree."""

    def __init__(self, tree: BlockTree, gaussians: Gaussians) -> None:
        self.tree = tree
        owner = tree.assign(gaussians.means)
        if bool((owner.diff() < 0).any()):
            gaussians = gaussians[owner.argsort(stable=True)]
        ends = owner.bincount(minlength=tree.num_blocks).cumsum(dim=0).tolist()
        # Where they come block by block, as in a checkpoint, blocks share their memory.
        self._blocks = [gaussians[start:end] for start, end in pairwise([0, *ends])]
        self._bounds: dict[int, Box | None] = {}

    def gaussians(self, block: int) -> Gaussians:
        return self._blocks[block]

    def bounds(self, block: int) -> Box | None:
        if block not in self._bounds:
            self._bounds[block] = bounds_of(self._blocks[block])
        return self._bounds[block]


class ChangedScene(BlockScene):
    """A scene of whose blocks `change` says what is seen, by number and Gaussians: as many or fewer, none of
    them farther out, for counts and bounds stay those of all."""

    def __init__(self, scene: BlockScene, change: Callable[[int, Gaussians], Gaussians]) -> None:
        self.tree, self.count, self.bounds = scene.tree, scene.count, scene.bounds
        self._scene, self._change = scene, change

    def gaussians(self, block: int) -> Gaussians:
        return self._change(block, self._scene.gaussians(block))


class HeldScene(BlockScene):
    """A scene's blocks on a device while none changes: read once, as far as there is room, bytes."""

    def __init__(self, scene: BlockScene, device: torch.device, room: int) -> None:
        self.tree, self.count, self.bounds = scene.tree, scene.count, scene.bounds
        self._scene, self._device, self._room = scene, device, room
        self._held: dict[int, Gaussians] = {}

    def gaussians(self, block: int) -> Gaussians:
        if block in self._held:
            return self._held[block]
        found = self._scene.drawn(block, self._device)
        if found.nbytes <= self._room:
            self._room -= found.nbytes
            self._held[block] = found
        return found


class StoredScene(VisitScene):
    """A scene in a ParameterStore, read block by block, with the active block laid over it. Blocks that were
    read stay in RAM, least recently used first out, within `ram_bytes`."""

    def __init__(self, tree: BlockTree, store: ParameterStore, ram_bytes: int = 2 << 30) -> None:
        self.tree, self.ram_bytes = tree, ram_bytes
        self.store = store
        """What is durable; to be read and written by way of the scene alone while there is one."""
        self._memory = BlockMemory(ram_bytes)
        self._unsaved: dict[BlockName, Packed] = {}
        self._writer = WriteBehind(store, self._saved)
        self._numbers, self._versions = itertools.count(1), dict[BlockName, int]()
        self._bounds: dict[BlockName, tuple[int, Box | None]] = {}
        self._stored_bounds: dict[BlockName, Box | None] = {}
        self._active: tuple[int | None, Callable[[], Gaussians]] | None = None
        self._persisted = time.monotonic()
        self._pending_by_block: dict[int, BlockState] = {}
        self.pending: BlockState | None = None
        """All Gaussians that wait for their blocks' visits, in the order in which they came."""
        self._sort(self.state(PENDING) if self.has(PENDING) else None)

    # -- changes -------------------------------------------------------------------------------------

    def persist(
        self,
        tree: BlockTree,
        blocks: Mapping[BlockName, BlockState | Packed],
        state: dict[str, Any],
        within: float = 0.0,
    ) -> None:
        """Take in the blocks that changed, under `tree`, and the run's state, as one moment of the run.

        Args:
            blocks: on the CPU, by number or special name, and tables of the run's under names of their own;
                they belong to the scene from now on, as `state` does.
            within: seconds after the last write began, when this is written. With 0, or where what waits
                exceeds `ram_bytes`, all is durable when this returns; but training goes on while an active
                block is written.

        Raises:
            StoreError: the disk refused, now or since the last call. Everything is in RAM, and waits for the
                next `persist` or `flush`.
        """
        packed = {n: block if isinstance(block, Packed) else block.packed() for n, block in blocks.items()}
        with self._writer.mutex:
            header = None if tree is self.tree else {**self.store.header, "tree": tree.to_json()}
            self.tree = tree
            for name, block in packed.items():
                self._memory.forget(name)
                self._unsaved[name] = block
                self._versions[name] = next(self._numbers)
                self._stored_bounds.pop(name, None)
            if header is not None or PENDING in blocks:
                self._sort(blocks.get(PENDING, self.pending))
            unsaved = self.unsaved_bytes  # under the lock: the writer takes out what it has written
            self._memory.shrink(unsaved)
            self._persisted = time.monotonic()
            self._writer.put(Snapshot(packed, header, state), within or math.inf)
        active = blocks.get(ACTIVE)
        if within <= 0 or (unsaved > self.ram_bytes and not active):
            self.flush()
        self._writer.check()

    def _sort(self, pending: BlockState | None) -> None:
        before, self.pending, self._pending_by_block = self._pending_by_block, pending, {}
        if pending is not None and len(pending):
            self._pending_by_block = split_by_block(pending, self.tree.assign(pending.gaussians.means))
        for block in before.keys() | self._pending_by_block.keys():
            old, new = before.get(block), self._pending_by_block.get(block)
            if not (old and new and torch.equal(old.gaussians.means, new.gaussians.means)):
                self._versions[block] = next(self._numbers)

    def _saved(self, snapshot: Snapshot) -> None:
        with self._writer.mutex:
            for name, block in snapshot.blocks.items():
                if self._unsaved.get(name) is block:
                    del self._unsaved[name]
                    if isinstance(name, int):  # what has a name of its own nobody reads here
                        self._memory.put(name, block)
            self._memory.shrink(self.unsaved_bytes)

    def is_due(self, within: float) -> bool:
        """Whether to persist again: nothing was for so many seconds, and nothing is being written. So RAM
        holds one copy of a large active block. 0 is no limit."""
        return 0 < within <= time.monotonic() - self._persisted and not self._writer.busy

    def flush(self) -> None:
        """Return when all that was persisted is durable; what failed before is tried again. See `persist`."""
        self._writer.flush()

    def close(self) -> None:
        """Write what waits, and let go of the store. Harmless when done twice."""
        try:
            self.flush()
        finally:
            self.store.close()

    def set_active(self, block: int | None, gaussians: Callable[[], Gaussians], sh_degree: int = 0) -> None:
        self._active, self._sh_degree = (block, gaussians), sh_degree

    def clear_active(self) -> None:
        self._active = None

    # -- what is there -------------------------------------------------------------------------------

    @property
    def is_active_as_a_whole(self) -> bool:
        """Whether all blocks are active, and `count` is right in sum alone."""
        return self._is_active(None)

    def _is_active(self, block: int | None) -> bool:
        """Whether the block is, or all of them are; with None, whether all are."""
        return self._active is not None and self._active[0] in (None, block)

    def has(self, name: BlockName) -> bool:
        """Whether there is such a block, or anything under such a special name."""
        return name in self._unsaved or name in self.store.blocks

    def rows(self, name: BlockName) -> int:
        block = self._unsaved.get(name)
        return self.store.counts(name) if block is None else block.rows

    def clocks(self, name: BlockName) -> Clocks:
        """How far a block had come when it was persisted; nothing is read."""
        return BlockState.clocks_of(self._meta(name))

    def _meta(self, name: BlockName) -> dict[str, Any]:
        block = self._unsaved.get(name)
        return self.store.meta(name) if block is None else block.meta

    def pending_for(self, block: int) -> BlockState | None:
        return self._pending_by_block.get(block)

    def state(self, name: BlockName) -> BlockState:
        """A block, or what is stored under a special name: whole, without its pending migrants."""
        return BlockState.unpacked(self._packed(name, whole=True))

    def _packed(self, name: BlockName, *, whole: bool) -> Packed:
        """What is stored under a name, or what others draw of it; in RAM from now on."""
        with self._writer.mutex:
            if name in self._unsaved:
                return self._unsaved[name]
            found = self._memory.get(name, whole=whole)
            if found is None:
                found = Packed(*self.store.load(name, None if whole else DRAWN))
                self._memory.put(name, found)
                self._memory.shrink(self.unsaved_bytes)
            return found

    def table(self, name: str) -> Packed | None:
        """A stored table of the run's; None where there is none of this name."""
        if not self.has(name):
            return None
        return self._unsaved.get(name) or Packed(*self.store.load(name))

    def read_ahead(self, block: int) -> None:
        """Have `state` of a block at hand soon; returns at once."""

        def read() -> None:
            with suppress(Exception):  # the caller that needs the block meets the error
                self._packed(block, whole=True)

        with self._writer.mutex:
            if block not in self._unsaved and self._memory.get(block, whole=True) is None:
                threading.Thread(target=read, daemon=True).start()

    def gaussians(self, block: int) -> Gaussians:
        if not self._is_active(block):
            return self.drawn(block, "cpu")
        active = self._all_active()
        return active[self.tree.assign(active.means) == block] if self.is_active_as_a_whole else active

    def _all_active(self) -> Gaussians:
        active = self._active[1]().detach()
        return active.of_degree(max(self._sh_degree, active.sh_degree))

    def drawn(self, block: int, device: torch.device | str, which: Which | None = None) -> Gaussians:
        """As for any scene; what is stored is cut while it is packed, and unpacked on the device."""
        if self._is_active(block):
            return super().drawn(block, device, which)
        packed, migrants = self._packed(block, whole=False), self.pending_for(block)
        rows = ~packed.tensors[IS_DEFERRED]  # they are not to be seen before the block's next visit
        if which is not None:
            rows &= which(packed.tensors["means"], packed.tensors["scales"])
        found = (packed if bool(rows.all()) else packed.drawn_at(rows)).gaussians(device=device)
        if migrants is None:
            return found
        return Gaussians.cat([found, _picked(migrants.gaussians, which).to(device)])

    def everything(self, device: torch.device | str) -> Gaussians:
        """All blocks, one after the other."""
        if self.is_active_as_a_whole:  # which block holds what is asked once
            active = self._all_active()
            return active[self.tree.assign(active.means).argsort(stable=True)].to(device)
        return Gaussians.cat([self.drawn(block, device) for block in range(self.tree.num_blocks)])

    def stored_with_pending(self, block: int) -> Gaussians:
        stored, migrants = self.stored(block), self.pending_for(block)
        return stored if migrants is None else Gaussians.cat([stored, migrants.gaussians])

    def stored(self, name: BlockName) -> Gaussians:
        """What is stored under a name, without pending migrants; deferred points included."""
        return self._packed(name, whole=False).gaussians()

    @property
    def unsaved_bytes(self) -> int:
        """RAM that blocks take which are not on disk yet."""
        return sum(block.nbytes for block in self._unsaved.values())

    @property
    def cached_bytes(self) -> int:
        """RAM that stored blocks take."""
        with self._writer.mutex:
            return self._memory.nbytes + self.unsaved_bytes

    def version(self, block: int) -> int:
        """Changes whenever the block's Gaussians do."""
        return self._versions.get(block, 0)

    def count(self, block: int) -> int:
        if not self._is_active(block):
            return self.rows(block) + len(self.pending_for(block) or ())
        # Right in sum. Which block holds what changes with every step, and is too slow to ask that often.
        return 0 if self.is_active_as_a_whole and block > 0 else len(self._active[1]())

    def parameters(self) -> int:
        """Of all Gaussians, what is active included; harmonics count up to the degree of each."""
        counted = 0 if self._active is None else count_parameters(self._active[1]().features_rest.detach())
        for block in range(self.tree.num_blocks):
            if not self._is_active(block):
                migrants = self.pending_for(block)
                counted += self._meta(block)["parameters"]
                counted += 0 if migrants is None else count_parameters(migrants.gaussians.features_rest)
        return counted

    def bounds(self, block: int) -> Box | None:
        if self._is_active(block):
            return bounds_of(self.gaussians(block))
        version = self.version(block)
        if block not in self._bounds or self._bounds[block][0] != version:
            with self._writer.mutex:  # it may be persisted meanwhile
                if block not in self._stored_bounds:
                    self._stored_bounds[block] = bounds_of(self.stored(block))
                migrants, box = self.pending_for(block), self._stored_bounds[block]
            if migrants is not None:  # the block itself need not be read again
                box = united(box, bounds_of(migrants.gaussians))
            self._bounds[block] = (version, box)
        return self._bounds[block][1]


def _picked(gaussians: Gaussians, which: Which | None) -> Gaussians:
    return gaussians if which is None else gaussians[which(gaussians.means, gaussians.scales)]
