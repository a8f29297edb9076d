"""Order: what a ray meets, cell by cell, found by brute force."""

from fractions import Fraction
from itertools import pairwise

import torch
from hypothesis import given
from hypothesis import strategies as st

from abcd_ns.engine.space.partition import build_grid
from abcd_ns.engine.space.tree import BlockTree, front_to_back
from tests.engine.space.test_tree import SEEDS, lattice_points, random_tree


def order_of(tree: BlockTree, center: torch.Tensor) -> torch.Tensor:
    """The order under test, [K]; each block is in it once."""
    order = torch.tensor(front_to_back(tree, center))
    assert sorted(order.tolist()) == list(range(tree.num_blocks))
    return order


@given(SEEDS, st.integers(1, 10))
def test_order_is_right_in_exact_arithmetic(seed, num_blocks):
    """Rays with small whole-numbered directions: along faces and straight through edges and corners."""
    tree = random_tree(seed, num_blocks)
    center, generator = lattice_points(seed, 1)[0], torch.Generator().manual_seed(seed)
    rank = order_of(tree, center).argsort().tolist()
    boxes = [
        [(low, high) for low, high in zip(cell.lower.tolist(), cell.upper.tolist(), strict=True)]
        for cell in map(tree.cell, range(num_blocks))
    ]
    start = [Fraction(c) for c in center.tolist()]
    for direction in torch.randint(-2, 3, (5, 3), generator=generator).tolist():
        crossings = {Fraction(0)}
        for axis, threshold in zip(tree.axis.tolist(), tree.threshold.tolist(), strict=True):
            if axis >= 0 and direction[axis]:
                crossings.add((Fraction(threshold) - start[axis]) / direction[axis])
        stops = sorted(t for t in crossings if t >= 0)
        middles = [(a + b) / 2 for a, b in pairwise(stops)] + [stops[-1] + 1]
        met = []
        for t in middles:
            point = [c + t * d for c, d in zip(start, direction, strict=True)]
            holders = [
                block
                for block, box in enumerate(boxes)
                if all(low <= x < high for x, (low, high) in zip(point, box, strict=True))
            ]
            assert len(holders) == 1
            met += holders
        places = [rank[block] for block in met]
        assert places == sorted(places)


def test_a_camera_on_the_plane_belongs_to_the_right():
    tree = build_grid(torch.zeros(0, 3), counts=(2, 1, 1))
    threshold = float(tree.threshold[0])
    center = torch.tensor([threshold, 0.0, 0.0], dtype=torch.float64)
    assert front_to_back(tree, center) == (1, 0)
    assert front_to_back(tree, torch.nextafter(center, center - 1)) == (0, 1)
