"""Which of a stored scene's Gaussians are exported, and where they are."""

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from abcd_ns.engine.gaussians.block_state import DRAWN, IS_DEFERRED, Packed
from abcd_ns.engine.gaussians.frames import Frame
from abcd_ns.engine.space.tree import BlockTree
from abcd_ns.engine.store import ParameterStore
from abcd_ns.engine.store.special_blocks import PENDING, BlockName
from abcd_ns.engine.train.run_state import RunState
from abcd_ns.engine.types import PARAM_NAMES, Gaussians
from abcd_ns.errors import UserError
from abcd_ns.formats.scene_file import shows
from abcd_ns.run.store import MADE_FOR

Box = tuple[float, float, float, float, float, float]  # x, y and z of its lower and then of its upper corner


def inside(box: Box, points: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
    """Which points lie in the box."""
    low, high = points.new_tensor(box[:3]), points.new_tensor(box[3:])
    return ((points >= low) & (points < high)).all(dim=1)


def check_trained(store: ParameterStore) -> None:
    """Raises UserError where no block of a run can be shown yet."""
    state = RunState.from_json(store.state) if store.state else None
    if state is None or (state.active is not None and state.active.is_whole):
        raise UserError(
            f"{store.folder}: no block has been trained yet. Wait until the warm-up is over, or use "
            "`ns-export gaussian-splat` on a checkpoint."
        )


@dataclass
class Shown:
    """The Gaussians of a store that are to be written: those in `box`, if there is one, in the frame `to`, or
    in their own without any."""

    store: ParameterStore
    to: Frame | None
    box: Box | None

    def __post_init__(self) -> None:
        check_trained(self.store)
        self._tree = BlockTree.from_json(self.store.header["tree"])
        self.blocks = range(self._tree.num_blocks)
        self.antialiased: bool = self.store.header.get(MADE_FOR, {}).get("antialiased", False)
        self._corners = torch.zeros(0, 3, dtype=torch.float64)
        """The lowest and highest coordinates so far."""
        self.widest = 0.0
        """The largest standard deviation so far, in the units of the file."""
        self.faint = 0
        """Of those that were counted, how many no rasterizer draws."""

    @cached_property
    def sh_degree(self) -> int:
        """Of all its Gaussians."""
        return Gaussians(**self._load(0, PARAM_NAMES)).sh_degree

    @property
    def largest(self) -> float:
        """Of all coordinates that were given so far, without their signs."""
        return float(self._corners.abs().max())

    @property
    def size(self) -> float:
        """The longest side of their box."""
        return float((self._corners[1] - self._corners[0]).max())

    def count(self, block: int) -> int:
        """How many of the block's Gaussians are to be written."""
        found = self._load(block, ("means", "opacities"))
        here, drawn = self._here(self._placed(found["means"])), shows(found["opacities"])
        self.faint += int((here & ~drawn).sum())
        return int((here & drawn).sum())

    def gaussians(self, block: int) -> Gaussians:
        """Those Gaussians."""
        found = Gaussians(**self._load(block, PARAM_NAMES))
        found = found[self._here(self._placed(found.means)) & shows(found.opacities)]
        if not len(found):
            return found
        exact = torch.cat((self._corners, self._placed(found.means)))
        self._corners = torch.stack((exact.amin(0), exact.amax(0)))
        found = found if self.to is None else self.to.gaussians(found)
        self.widest = max(self.widest, math.exp(found.scales.max()))
        return found

    def _load(self, block: int, names: tuple[str, ...]) -> dict[str, Tensor]:
        """These parameters, the means among them, of the block's active Gaussians and of pending migrants."""
        found = self._columns(block, names)
        seen = ~found.pop(IS_DEFERRED)
        found = {name: value[seen] for name, value in found.items()}
        if PENDING not in self.store.blocks:
            return found
        pending = self._columns(PENDING, names)
        here = self._tree.assign(pending["means"]) == block
        return {name: torch.cat([value, pending[name][here]]) for name, value in found.items()}

    def _columns(self, name: BlockName, names: tuple[str, ...]) -> dict[str, Tensor]:
        if "features_rest" not in names:
            return self.store.load(name, (*names, IS_DEFERRED))[0]
        packed = Packed(*self.store.load(name, DRAWN))
        return {**dict(packed.gaussians().items()), IS_DEFERRED: packed.tensors[IS_DEFERRED]}

    def _placed(self, means: Tensor) -> Tensor:
        return means.double() if self.to is None else self.to.points(means)

    def _here(self, means: Tensor) -> Bool[Tensor, "n"]:
        return torch.ones(len(means), dtype=torch.bool) if self.box is None else inside(self.box, means)
