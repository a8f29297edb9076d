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
Row = tuple[_Index, float, _Index, _Index, _Index]


class _Stored(msgspec.Struct):
    """A tree as JSON has it."""

    format: Literal["abcd_ns.block_tree/1"]
    nodes: tuple[Row, ...]


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


@dataclass(frozen=True)
class BlockTree:
    """A k-d tree over all of R^3 with one block at each leaf.

    A point with x[axis] < threshold belongs to the left child, any other to the right one, compared in
    float64 (which holds every float32 exactly). So the cells overlap nowhere and leave nothing out. Node 0
    is the root, every node comes after its parent, and a tree of one block is a single leaf.

    Raises:
        ValueError: the rows are no such tree, or a threshold lies outside its node's box.
    """

    rows: tuple[Row, ...]
    """Of an inner node (axis, threshold, left, right, -1): the axis that it splits, 0 to 2, where, world
    units, and its children below the threshold and not below it. Of a leaf (-1, 0.0, -1, -1, block); blocks
    are 0 to num_blocks - 1."""

    def __post_init__(self) -> None:
        if not _is_tree(self.rows):
            wanted = "a binary tree, parents first, with blocks 0 to K - 1 at its leaves"
            raise ValueError(f"block tree: not {wanted}")
        for node, (axis, threshold, *_) in enumerate(self.rows):
            lower, upper = self._bounds[node]
            if axis >= 0 and not lower[axis] < threshold < upper[axis]:
                raise ValueError(f"block tree: node {node} has a threshold outside its own box")

    @property
    def num_blocks(self) -> int:
        return (len(self.rows) + 1) // 2

    @cached_property
    def parent(self) -> list[int]:
        """Of each node; -1 for the root."""
        found = [-1] * len(self.rows)
        for node, (_, _, left, right, _) in enumerate(self.rows):
            if left >= 0:
                found[left] = found[right] = node
        return found

    @cached_property
    def _bounds(self) -> list[tuple[list[float], list[float]]]:
        """The lower and upper corners of all nodes' boxes."""
        found = [([-math.inf] * 3, [math.inf] * 3)]
        for node, parent in enumerate(self.parent[1:], start=1):
            axis, threshold, left, _, _ = self.rows[parent]
            lower, upper = map(list, found[parent])
            side = upper if left == node else lower
            side[axis] = threshold
            found.append((lower, upper))
        return found

    @cached_property
    def _columns(self) -> tuple[Tensor, ...]:
        """The rows as tensors on the CPU, one for each kind of number."""
        axis, threshold, *others = torch.tensor(self.rows, dtype=torch.float64).unbind(dim=1)
        return axis.long(), threshold, *(column.long() for column in others)

    @cached_property
    def _leaf_of(self) -> dict[int, int]:
        return {block: node for node, (_, _, _, _, block) in enumerate(self.rows) if block >= 0}

    def assign(self, points: Float[Tensor, "n 3"]) -> Int64[Tensor, "n"]:
        """The block that holds each point, on the points' device. A NaN goes to the right."""
        return torch.cat([self._assign(part) for part in points.split(CHUNK)])

    def _assign(self, points: Tensor) -> Tensor:
        exact = in_float64(points)
        device = exact.device
        axis, threshold, left, right, block = (column.to(device) for column in self._columns)
        node = torch.zeros(len(points), dtype=torch.int64, device=device)
        while bool((axis[node] >= 0).any()):
            along = axis[node]
            value = exact.gather(1, along.clamp(min=0)[:, None])[:, 0]
            child = torch.where(value < threshold[node], left[node], right[node])
            node = torch.where(along >= 0, child, node)
        return block[node].to(points.device)

    def node_of(self, block: int) -> int:
        if block not in self._leaf_of:
            raise ValueError(f"block {block} does not exist: the tree has blocks 0 to {self.num_blocks - 1}")
        return self._leaf_of[block]

    def box(self, node: int) -> Box:
        """The part of space under a node; all of it for the root."""
        lower, upper = (torch.tensor(corner, dtype=torch.float64) for corner in self._bounds[node])
        return Box(lower, upper)

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
        return BlockTree((*rows, (-1, 0.0, -1, -1, block), (-1, 0.0, -1, -1, self.num_blocks)))

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
            return BlockTree(msgspec.json.decode(text, type=_Stored).nodes)
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


def _is_tree(rows: Sequence[Row]) -> bool:
    """Whether the rows form one binary tree, parents first, with each block at one leaf."""
    inner = [(node, row) for node, row in enumerate(rows) if row[0] >= 0]
    leaves = [row for row in rows if row[0] < 0]
    children = [(child, node) for node, row in inner for child in row[2:4]]
    # Every node but the root is the child of exactly one earlier node: then there are no cycles or islands.
    return (
        len(rows) > 0
        and sorted(child for child, _ in children) == list(range(1, len(rows)))
        and all(child > node for child, node in children)
        and all(row[0] <= 2 and row[4] == -1 for _, row in inner)
        and all(row[:4] == (-1, 0.0, -1, -1) for row in leaves)
        and sorted(row[4] for row in leaves) == list(range(len(leaves)))
    )


def in_float64(values: Tensor) -> Tensor:
    """In float64, without gradients; by way of the CPU for Apple's GPUs, which have no float64."""
    values = values.detach()
    return (values.cpu() if values.device.type == "mps" else values).double()
