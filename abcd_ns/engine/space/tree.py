"""Blocks: a k-d tree whose leaves are axis-aligned cells that tile all of space, and their order."""

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Literal

import msgspec
import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from abcd_ns.engine.types import CHUNK

_Index = Annotated[int, msgspec.Meta(ge=-1, lt=1 << 31)]


class _Stored(msgspec.Struct):
    """A tree as JSON has it."""

    format: Literal["abcd_ns.block_tree/1"]
    nodes: list[tuple[_Index, float, _Index, _Index, _Index]]
    """(axis, threshold, left, right, block) of each."""


@dataclass(frozen=True, eq=False)
class Box:
    """An axis-aligned box, world units. It holds its lower faces and not its upper ones; may be infinite."""

    lower: Float64[Tensor, "3"]
    upper: Float64[Tensor, "3"]

    def __post_init__(self) -> None:
        if not bool((self.lower <= self.upper).all()):
            raise ValueError(f"a box needs lower <= upper, not {self.lower.tolist()}, {self.upper.tolist()}")

    def contains(self, points: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
        """Whether lower <= x < upper on all axes, compared in float64 as BlockTree.assign does."""
        exact = in_float64(points)
        inside = (exact >= self.lower.to(exact.device)) & (exact < self.upper.to(exact.device))
        return inside.all(dim=1).to(points.device)

    def grown(self, margin: float) -> "Box":
        """Moved outward by `margin` >= 0 (world units) on every face."""
        return Box(self.lower - margin, self.upper + margin)


EVERYWHERE = Box(torch.full((3,), -math.inf).double(), torch.full((3,), math.inf).double())


@dataclass(frozen=True, eq=False)
class BlockTree:
    """A k-d tree over all of R^3 with one block at each leaf; all tensors live on the CPU.

    A point with x[axis] < threshold belongs to the left child, any other to the right one, compared in
    float64 (which holds every float32 exactly). So the cells overlap nowhere and leave nothing out. Node 0
    is the root, every node comes after its parent, and a tree of one block is a single leaf.

    Raises:
        ValueError: the arrays are no such tree, or a threshold lies outside its node's box.
    """

    axis: Int64[Tensor, "m"]
    """The axis that an inner node splits, 0 to 2; -1 for a leaf."""
    threshold: Float64[Tensor, "m"]
    """Where it splits, world units; 0 for a leaf."""
    left: Int64[Tensor, "m"]
    """The child below the threshold; -1 for a leaf."""
    right: Int64[Tensor, "m"]
    """The child at and above the threshold; -1 for a leaf."""
    block: Int64[Tensor, "m"]
    """A leaf's block, 0 to num_blocks - 1; -1 for an inner node."""

    def __post_init__(self) -> None:
        if not _is_tree(self):
            wanted = "a binary tree, parents first, with blocks 0 to K - 1 at its leaves"
            raise ValueError(f"block tree: not {wanted}")
        lower, upper = self._bounds
        node = (self.axis >= 0).nonzero()[:, 0]
        axis, threshold = self.axis[node], self.threshold[node]
        cuts = (lower[node, axis] < threshold) & (threshold < upper[node, axis])
        if not bool(cuts.all()):
            raise ValueError(f"block tree: node {int(node[~cuts][0])} has a threshold outside its own box")

    def __eq__(self, other: object) -> bool:
        return isinstance(other, BlockTree) and self.to_json() == other.to_json()

    def __hash__(self) -> int:
        return hash(self.to_json())

    @property
    def num_blocks(self) -> int:
        return (self.axis.shape[0] + 1) // 2

    @cached_property
    def parent(self) -> Int64[Tensor, "m"]:
        """-1 for the root."""
        inner, parent = (self.axis >= 0).nonzero()[:, 0], torch.full_like(self.axis, -1)
        parent[self.left[inner]] = parent[self.right[inner]] = inner
        return parent

    @cached_property
    def _bounds(self) -> tuple[Float64[Tensor, "m 3"], Float64[Tensor, "m 3"]]:
        """The lower and upper corners of all nodes' boxes."""
        lower, upper = [[-math.inf] * 3], [[math.inf] * 3]
        axis, threshold, left = self.axis.tolist(), self.threshold.tolist(), self.left.tolist()
        for node, parent in enumerate(self.parent.tolist()[1:], start=1):
            lower.append(list(lower[parent]))
            upper.append(list(upper[parent]))
            side = upper if left[parent] == node else lower
            side[node][axis[parent]] = threshold[parent]
        return torch.tensor(lower, dtype=torch.float64), torch.tensor(upper, dtype=torch.float64)

    @cached_property
    def rows(self) -> list[tuple[int, float, int, int, int]]:
        """(axis, threshold, left, right, block) of each node, as Python numbers."""
        columns = (self.axis, self.threshold, self.left, self.right, self.block)
        return list(zip(*(column.tolist() for column in columns), strict=True))

    def assign(self, points: Float[Tensor, "n 3"]) -> Int64[Tensor, "n"]:
        """The block that holds each point, on the points' device. A NaN goes to the right."""
        return torch.cat([self._assign(part) for part in points.split(CHUNK)])

    def _assign(self, points: Tensor) -> Tensor:
        exact = in_float64(points)
        device = exact.device
        axis, threshold = self.axis.to(device), self.threshold.to(device)
        left, right, block = self.left.to(device), self.right.to(device), self.block.to(device)
        node = torch.zeros(len(points), dtype=torch.int64, device=device)
        while bool((axis[node] >= 0).any()):
            along = axis[node]
            value = exact.gather(1, along.clamp(min=0)[:, None])[:, 0]
            child = torch.where(value < threshold[node], left[node], right[node])
            node = torch.where(along >= 0, child, node)
        return block[node].to(points.device)

    def node_of(self, block: int) -> int:
        """The leaf of a block."""
        if not 0 <= block < self.num_blocks:
            raise ValueError(f"block {block} does not exist: the tree has blocks 0 to {self.num_blocks - 1}")
        return int((self.block == block).nonzero()[0, 0])

    def box(self, node: int) -> Box:
        """The part of space under a node; all of it for the root."""
        lower, upper = self._bounds
        return Box(lower[node].clone(), upper[node].clone())

    def cell(self, block: int) -> Box:
        """The part of space that a block holds."""
        return self.box(self.node_of(block))

    def leaves(self, node: int = 0) -> tuple[int, ...]:
        """The blocks under a node, from left to right."""
        found, stack = [], [node]
        while stack:
            _, _, left, right, block = self.rows[stack.pop()]
            if left < 0:
                found.append(block)
            else:
                stack += [right, left]
        return tuple(found)

    def split(self, block: int, axis: int, threshold: float) -> "BlockTree":
        """A new tree in which the block's cell is cut in two: the part below `threshold` keeps the block's
        id, the other becomes block `num_blocks`.

        Raises:
            ValueError: no such block or axis, or the plane does not cut the block's cell.
        """
        node, rows = self.node_of(block), list(self.rows)
        rows[node] = (axis, float(threshold), len(rows), len(rows) + 1, -1)
        return tree_from_rows([*rows, (-1, 0.0, -1, -1, block), (-1, 0.0, -1, -1, self.num_blocks)])

    def to_json(self) -> str:
        """As text that from_json turns back into the same tree, bit for bit."""
        # json writes a float as repr does: the shortest text that reads back as the same float64.
        return json.dumps({"format": "abcd_ns.block_tree/1", "nodes": self.rows})

    @staticmethod
    def from_json(text: str) -> "BlockTree":
        """The tree that to_json wrote.

        Raises:
            ValueError: the text is not JSON, not of this format, or describes no tree.
        """
        try:
            return tree_from_rows(msgspec.json.decode(text, type=_Stored).nodes)
        except msgspec.MsgspecError as error:
            raise ValueError(f"block tree: {error}") from error


def node_children_in_order(tree: BlockTree, node: int, center: Sequence[float]) -> tuple[int, int]:
    """(the child on the side of `center`, the other child) of an inner node: near side first.

    A ray that starts on one side of a plane can cross to the other but never back. So whatever lies on the
    camera's side of a split is in front of whatever lies beyond it, along every ray; by induction over the
    tree there is one order for the whole image. (Fuchs, Kedem and Naylor 1980, "On visible surface generation
    by a priori tree structures".) The centre is compared with the threshold as BlockTree.assign does.
    """
    axis, threshold, left, right, _ = tree.rows[node]
    return (left, right) if center[axis] < threshold else (right, left)


def nodes_in_order(tree: BlockTree, center: Float[Tensor, "3"]) -> Iterator[int]:
    """All nodes as seen from the camera centre (world space): each before what is under it, and all that is
    under the nearer of two children before the other one."""
    stack, at = [0], center.tolist()
    while stack:
        node = stack.pop()
        yield node
        if tree.rows[node][0] >= 0:
            near, far = node_children_in_order(tree, node, at)
            stack += [far, near]


def front_to_back(tree: BlockTree, center: Float[Tensor, "3"]) -> tuple[int, ...]:
    """All blocks, nearest first, as seen from the camera centre (world space)."""
    blocks = (tree.rows[node][4] for node in nodes_in_order(tree, center))
    return tuple(block for block in blocks if block >= 0)


def tree_from_rows(rows: Sequence[Sequence[int | float]]) -> BlockTree:
    """A tree from (axis, threshold, left, right, block) of each node."""
    axis, threshold, *rest = torch.tensor(rows, dtype=torch.float64).reshape(-1, 5).unbind(dim=1)
    return BlockTree(axis.long(), threshold.clone(), *(column.long() for column in rest))


def _is_tree(tree: BlockTree) -> bool:
    """Whether the arrays form one binary tree, parents first, with each block at one leaf."""
    size = tree.axis.shape[0]
    inner = tree.axis >= 0
    children = torch.cat([tree.left[inner], tree.right[inner]])
    # Every node but the root is the child of exactly one earlier node: then there are no cycles or islands.
    if size == 0 or sorted(children.tolist()) != list(range(1, size)):
        return False
    parents = inner.nonzero()[:, 0].repeat(2)
    leaves = torch.stack([tree.axis + 1, tree.left + 1, tree.right + 1, tree.threshold != 0])[:, ~inner]
    return bool(
        (children > parents).all()
        and (tree.axis <= 2).all()
        and (tree.block[inner] == -1).all()
        and not leaves.any()
        and sorted(tree.block[~inner].tolist()) == list(range((size + 1) // 2))
    )


def in_float64(values: Tensor) -> Tensor:
    """In float64, without gradients; by way of the CPU for Apple's GPUs, which have no float64."""
    values = values.detach()
    return (values.cpu() if values.device.type == "mps" else values).double()
