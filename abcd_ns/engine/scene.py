"""Where the blocks of a scene are to be found: at rest in the store, one of them live in parameters."""

from collections import OrderedDict
from collections.abc import Callable, Mapping
from itertools import accumulate, pairwise
from typing import Any, Protocol, runtime_checkable

from torch import Tensor

from abcd_ns.engine.blocks import BlockTree, Box
from abcd_ns.engine.culling import bounds_of
from abcd_ns.engine.scaffold import drawn, revealed
from abcd_ns.engine.storage import ParameterStore
from abcd_ns.engine.types import PARAM_NAMES, Gaussians


@runtime_checkable
class BlockScene(Protocol):
    """Gaussians by block."""

    tree: BlockTree

    def gaussians(self, block: int) -> Gaussians:
        """The block's Gaussians, without a graph, wherever they are kept."""
        ...

    def version(self, block: int) -> int:
        """Changes whenever the block's Gaussians do."""
        ...

    def count(self, block: int) -> int:
        """How many Gaussians the block has."""
        ...

    def bounds(self, block: int) -> Box | None:
        """`bounds_of` the block's Gaussians."""
        ...


class MemoryScene:
    """A scene that is one list of Gaussians in memory, parted by a tree."""

    def __init__(self, tree: BlockTree, gaussians: Gaussians) -> None:
        self.tree = tree
        owner = tree.assign(gaussians.means)
        if bool((owner.diff() < 0).any()):
            gaussians = gaussians[owner.argsort(stable=True)]
        sizes = owner.bincount(minlength=tree.num_blocks).tolist()
        ends = list(accumulate(sizes, initial=0))
        # Where they come block by block, as in a checkpoint, blocks share their memory.
        self._blocks = [gaussians[start:end] for start, end in pairwise(ends)]
        self._bounds: dict[int, Box | None] = {}

    def gaussians(self, block: int) -> Gaussians:
        return self._blocks[block]

    def version(self, block: int) -> int:  # noqa: ARG002 - the scene never changes
        return 0

    def count(self, block: int) -> int:
        return len(self._blocks[block])

    def bounds(self, block: int) -> Box | None:
        if block not in self._bounds:
            self._bounds[block] = bounds_of(self._blocks[block])
        return self._bounds[block]


class StoredScene:
    """A scene at rest in a ParameterStore, read block by block, with the live block laid over it.

    Blocks that were read stay in RAM, least recently used first out, within `ram_bytes`.
    """

    def __init__(self, tree: BlockTree, store: ParameterStore, ram_bytes: int = 2 << 30) -> None:
        self.tree = tree
        self.store = store
        self.ram_bytes = ram_bytes
        self._ram: OrderedDict[tuple[int, int], Gaussians] = OrderedDict()
        self._bounds: dict[int, tuple[int, Box | None]] = {}
        self._live: tuple[int | None, Callable[[], Gaussians]] | None = None

    def rest(
        self,
        tree: BlockTree,
        blocks: Mapping[int, tuple[dict[str, Tensor], dict[str, Any]]],
        state: dict[str, Any],
    ) -> None:
        """Commit the blocks that changed, under `tree`, with the run's state.

        Raises:
            StoreError: the disk refused; the scene is as it was before.
        """
        header = None if tree is self.tree else {**self.store.header, "tree": tree.to_json()}
        self.store.commit(blocks, header=header, state=state)
        self.tree = tree

    def lay_over(self, block: int | None, live: Callable[[], Gaussians]) -> None:
        """From now on `block`, or with None the whole scene, is what `live` returns, not what is stored."""
        self._live = (block, live)

    def lift(self) -> None:
        """No block is live any more."""
        self._live = None

    @property
    def is_live_as_a_whole(self) -> bool:
        """Whether all blocks are live, and `count` is right in sum alone."""
        return self._live is not None and self._live[0] is None

    def gaussians(self, block: int) -> Gaussians:
        if self._live is not None and self._live[0] is None:
            everything = self._live[1]().detach()
            return everything[self.tree.assign(everything.means) == block]
        if self._live is not None and self._live[0] == block:
            return self._live[1]().detach()
        return drawn(self._stored(block))

    def at_rest(self, block: int) -> Gaussians:
        """The block as a visit will find it, whatever is live."""
        return revealed(self._stored(block))

    def _stored(self, block: int) -> Gaussians:
        key = (block, self.version(block))
        if key not in self._ram:
            self._ram[key] = Gaussians(**self.store.load_names(block, PARAM_NAMES))
        self._ram.move_to_end(key)
        found = self._ram[key]
        while len(self._ram) > 1 and self.cached_bytes > self.ram_bytes:
            self._ram.popitem(last=False)
        return found

    @property
    def cached_bytes(self) -> int:
        """RAM that blocks take which were read and kept."""
        return sum(map(_nbytes, self._ram.values()))

    def version(self, block: int) -> int:
        return self.store.version(block)

    def count(self, block: int) -> int:
        if self._live is not None and self._live[0] is None:
            # Right in sum. Who lives where changes with every step, and is too dear to ask that often.
            return len(self._live[1]()) if block == 0 else 0
        if self._live is not None and self._live[0] == block:
            return len(self._live[1]())
        return self.store.counts(block)

    def bounds(self, block: int) -> Box | None:
        if self._live is not None and self._live[0] in (None, block):
            return bounds_of(self.gaussians(block))
        version = self.version(block)
        if block not in self._bounds or self._bounds[block][0] != version:
            self._bounds[block] = (version, bounds_of(self.at_rest(block)))
        return self._bounds[block][1]


def _nbytes(gaussians: Gaussians) -> int:
    return sum(value.nbytes for _, value in gaussians.items())
