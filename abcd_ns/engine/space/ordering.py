"""Front-to-back order of blocks: near side first at every split, right for every ray from the camera.

A ray that starts on one side of a plane can cross to the other but never back. So whatever lies on the
camera's side of a split is in front of whatever lies beyond it, along every ray; by induction over the
tree there is one order for the whole image. Sorting cells by the depth of their centres has no such
guarantee. (Fuchs, Kedem and Naylor 1980, "On visible surface generation by a priori tree structures".)
"""

from collections.abc import Iterator

from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.space.tree import BlockTree


def node_children_in_order(tree: BlockTree, node: int, center: Float[Tensor, "3"]) -> tuple[int, int]:
    """(the child on the side of `center`, the other child) of an inner node.

    The centre is compared with the threshold in float64, by the rule that BlockTree.assign uses for
    points: exactly on the plane counts as right.
    """
    axis, left, right = (int(column[node]) for column in (tree.axis, tree.left, tree.right))
    return (left, right) if float(center[axis]) < float(tree.threshold[node]) else (right, left)


def nodes_in_order(tree: BlockTree, center: Float[Tensor, "3"]) -> Iterator[int]:
    """All nodes as seen from the camera centre (world space): each before what is under it, and all that is
    under the nearer of two children before the other one."""
    stack = [0]
    while stack:
        node = stack.pop()
        yield node
        if int(tree.axis[node]) >= 0:
            near, far = node_children_in_order(tree, node, center)
            stack += [far, near]


def front_to_back(tree: BlockTree, center: Float[Tensor, "3"]) -> tuple[int, ...]:
    """All blocks, nearest first, as seen from the camera centre (world space)."""
    blocks = (int(tree.block[node]) for node in nodes_in_order(tree, center))
    return tuple(block for block in blocks if block >= 0)
