"""Blocks: every point in exactly one, whatever the points; balance; splitting; JSON."""

import json
import math
import random

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from abcd_ns.engine.space.partition import MAX_BLOCKS, build_grid, build_kd
from abcd_ns.engine.space.tree import BlockTree

SEEDS = st.integers(0, 2**32 - 1)


def random_tree(seed: int, num_blocks: int) -> BlockTree:
    """Random splits at multiples of 1/4 in [-2, 2], so that many cells share planes, edges and corners."""
    rng = random.Random(seed)
    tree = build_kd(torch.zeros(0, 3), 1)
    while tree.num_blocks < num_blocks:
        block, axis, threshold = rng.randrange(tree.num_blocks), rng.randrange(3), rng.randint(-8, 8) / 4
        cell = tree.cell(block)
        if cell.lower[axis] < threshold < cell.upper[axis]:
            tree = tree.split(block, axis, threshold)
    return tree


def lattice_points(seed: int, n: int) -> torch.Tensor:
    """Points on the planes that random_tree uses, one step of float32 beside them, and anywhere."""
    rng = random.Random(seed)

    def coordinate() -> float:
        value = torch.tensor(rng.randint(-8, 8) / 4)
        shift = rng.choice(["on", "on", "below", "above", "anywhere"])
        if shift == "anywhere":
            return rng.uniform(-3, 3)
        towards = {"on": value, "below": torch.tensor(-math.inf), "above": torch.tensor(math.inf)}[shift]
        return float(torch.nextafter(value, towards))

    return torch.tensor([[coordinate() for _ in range(3)] for _ in range(n)])


def walk(tree: BlockTree, point: list[float]) -> int:
    """The block of one point, by the rule in the docstring."""
    axis, threshold, left, right, block = tree.rows[0]
    while axis >= 0:
        axis, threshold, left, right, block = tree.rows[left if point[axis] < threshold else right]
    return block


def counts_of(tree: BlockTree, points: torch.Tensor) -> list[int]:
    return torch.bincount(tree.assign(points), minlength=tree.num_blocks).tolist()


def assert_proper(tree: BlockTree, num_blocks: int) -> None:
    """Exactly these blocks, and a real piece of space in each."""
    assert sorted(tree.leaves()) == list(range(tree.num_blocks)) == list(range(num_blocks))
    for cell in map(tree.cell, range(num_blocks)):
        assert bool((cell.lower < cell.upper).all())


@given(SEEDS, st.integers(1, 30))
def test_every_point_lies_in_exactly_one_cell_the_one_assigned(seed, num_blocks):
    tree, points = random_tree(seed, num_blocks), lattice_points(seed, 50)
    assigned = tree.assign(points)
    inside = torch.stack([tree.cell(block).contains(points) for block in range(num_blocks)])
    assert torch.equal(inside.sum(dim=0), torch.ones(50, dtype=torch.int64))
    assert torch.equal(inside.int().argmax(dim=0), assigned)
    assert assigned.tolist() == [walk(tree, point) for point in points.tolist()]


def test_assignment_is_exact_in_float64():
    threshold = 0.1  # Not a float32: its two neighbours in float32 lie on either side.
    tree = build_kd(torch.zeros(0, 3), 1).split(0, 2, threshold)
    above = torch.tensor([0.0, 0.0, 0.1])
    below = torch.nextafter(above, torch.tensor(-1.0))
    assert float(below[2]) < threshold < float(above[2])
    assert tree.assign(torch.stack([below, above])).tolist() == [0, 1]
    neighbours = torch.tensor([[0, 0, math.nextafter(threshold, 0)], [0, 0, threshold]], dtype=torch.float64)
    assert tree.assign(neighbours).tolist() == [0, 1]


@pytest.mark.parametrize(("num_blocks", "n"), [(1, 33), (7, 100), (8, 100), (13, 1009), (32, 33)])
def test_kd_counts_differ_by_at_most_one(num_blocks, n):
    generator = torch.Generator().manual_seed(n)
    points = torch.stack([torch.randperm(n, generator=generator) for _ in range(3)], dim=1) / 7
    tree = build_kd(points, num_blocks)
    assert_proper(tree, num_blocks)
    counts = counts_of(tree, points)
    assert max(counts) - min(counts) <= 1
    assert build_kd(points, num_blocks) == tree


@given(SEEDS, st.integers(1, 12), st.sampled_from([0, 1, 2, 4, 11, 40]), st.integers(1, 5))
def test_kd_survives_any_duplicates(seed, num_blocks, n, values):
    """Few distinct coordinates per axis: equal points, lines, planes and lattices."""
    rng = random.Random(seed)
    scale = rng.choice([1e-30, 1.0, 1e7, 1e30])
    points = torch.tensor([[rng.randrange(values) * scale for _ in range(3)] for _ in range(n)]).reshape(n, 3)
    tree = build_kd(points, num_blocks)
    assert_proper(tree, num_blocks)
    assert sum(counts_of(tree, points)) == n


def test_kd_cuts_elsewhere_when_coordinates_coincide_on_the_widest_axis():
    points = torch.zeros(100, 3)
    points[:10, 0] = 1000.0
    points[:, 1] = torch.arange(100) / 100
    tree = build_kd(points, 2)
    assert tree.rows[0][0] == 1
    assert counts_of(tree, points) == [50, 50]


def test_kd_ignores_outliers_when_it_picks_an_axis():
    points = torch.rand(1000, 3, generator=torch.Generator().manual_seed(3))
    points[:, 1] *= 2
    points[:20, 0] = 1e7
    points[20:40, 2] = -1e7
    assert build_kd(points, 2).rows[0][0] == 1


def test_kd_thresholds_lie_strictly_between_coordinates():
    for dtype in (torch.float32, torch.float64):
        points = torch.tensor([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]], dtype=dtype)
        points[1, 0] = torch.nextafter(points[1, 0], 2 * points[1, 0])
        assert counts_of(build_kd(points, 2), points) == [1, 1]


@pytest.mark.parametrize(
    ("build", "points", "cells", "message"),
    [
        (build_kd, torch.zeros(3, 3), 0, "cannot build 0 blocks"),
        (build_kd, torch.tensor([[0.0, math.nan, 0.0]]), 2, "1 of 1 points are NaN"),
        (build_grid, torch.zeros(3, 3), (1, 0, 1), "at least one cell on each axis"),
        (build_grid, torch.zeros(3, 3), (MAX_BLOCKS, 2, 1), "at least one cell on each axis"),
        (build_grid, torch.full((1, 3), math.nan), (2, 1, 1), "1 of 1 points are NaN"),
    ],
)
def test_what_cannot_be_built_is_refused(build, points, cells, message):
    with pytest.raises(ValueError, match=message):
        build(points, cells)


def test_grid_by_counts_is_regular_and_unbounded():
    points = torch.rand(4001, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([8.0, 4.0, 2.0])
    points[:3] = 1e7
    tree = build_grid(points, counts=(4, 2, 1))
    assert_proper(tree, 8)
    planes = [sorted({row[1] for row in tree.rows if row[0] == axis}) for axis in range(3)]
    assert [len(each) for each in planes] == [3, 1, 0]
    assert planes[0][1] - planes[0][0] == pytest.approx(planes[0][2] - planes[0][1])
    assert planes[0][1] == pytest.approx(4.0, abs=0.2)
    # A block for each combination of columns, as a regular grid has.
    columns = torch.bucketize(points[3:].double(), torch.tensor(planes[0]).double(), right=True)[:, 0]
    rows = (points[3:, 1].double() >= planes[1][0]).long()
    assert len(set(zip(tree.assign(points[3:]).tolist(), columns.tolist(), rows.tolist(), strict=True))) == 8


@pytest.mark.parametrize("points", [torch.zeros(0, 3), torch.full((4, 3), -7.0)])
def test_grid_survives_points_without_extent(points):
    tree = build_grid(points, counts=(2, 3, 1))
    assert_proper(tree, 6)
    assert sum(counts_of(tree, points)) == len(points)


@given(SEEDS, st.integers(1, 12), st.integers(0, 2))
def test_split_moves_nothing_else(seed, num_blocks, axis):
    tree, points = random_tree(seed, num_blocks), lattice_points(seed, 60)
    block = seed % num_blocks
    cell = tree.cell(block)
    low, high = max(float(cell.lower[axis]), -4.0), min(float(cell.upper[axis]), 4.0)
    threshold = low + (high - low) * 0.375
    split = tree.split(block, axis, threshold)
    before, after = tree.assign(points), split.assign(points)
    moved = before != after
    upper_half = (before == block) & (points[:, axis].double() >= threshold)
    assert torch.equal(moved, upper_half)
    assert (after[moved] == num_blocks).all()
    for other in set(range(num_blocks)) - {block}:
        assert torch.equal(split.cell(other).lower, tree.cell(other).lower)
        assert torch.equal(split.cell(other).upper, tree.cell(other).upper)


def test_split_refuses_what_does_not_cut():
    tree = build_kd(torch.zeros(0, 3), 1).split(0, 0, 1.0)
    for threshold in (1.0, 2.0, math.inf, math.nan):
        with pytest.raises(ValueError, match="threshold outside"):
            tree.split(0, 0, threshold)
    with pytest.raises(ValueError, match="block 2 does not exist"):
        tree.split(2, 0, 0.0)


@given(SEEDS, st.integers(1, 12), st.floats(-3, 3).filter(lambda t: t * 4 != round(t * 4)))
def test_json_round_trip_is_exact(seed, num_blocks, threshold):
    tree = random_tree(seed, num_blocks)
    block = walk(tree, [threshold] * 3)
    tree = tree.split(block, seed % 3, threshold)
    again = BlockTree.from_json(tree.to_json())
    assert again == tree
    assert hash(again) == hash(tree)
    assert again != random_tree(seed, num_blocks)


def edited(node: int, column: int, value) -> str:
    """The JSON of a small tree with one number replaced."""
    data = json.loads(build_grid(torch.rand(9, 3), counts=(2, 2, 1)).to_json())
    data["nodes"][node][column] = value
    return json.dumps(data)


HEAD = '{"format": "abcd_ns.block_tree/1"'
NO_TREE = [(0, 0, 3), (0, 0, -1), (2, 1, 1.0), (0, 2, 0), (0, 2, 99)]
NO_TREE += [(1, 3, 4), (2, 2, 5), (2, 4, 1), (0, 4, 0)]
REFUSED = {
    "truncated": ["{"],
    "malformed": [edited(0, 1, math.nan), edited(0, 1, math.inf)],
    "Expected": ["[]", HEAD + ', "nodes": [[0, 1.0]]}', *(edited(0, 0, k) for k in (-2, 0.5, True, 10**30))],
    "Invalid enum value": ['{"format": "something else"}'],
    "missing required field": [HEAD + "}"],
    "not a binary tree": [HEAD + ', "nodes": []}', *(edited(*change) for change in NO_TREE)],
    "threshold outside": [
        build_kd(torch.zeros(0, 3), 1).split(0, 0, 1.0).split(0, 0, 0.5).to_json().replace("0.5", "1.5")
    ],
}


@pytest.mark.parametrize(("message", "text"), [(m, text) for m, texts in REFUSED.items() for text in texts])
def test_json_that_is_no_tree_is_refused(message, text):
    with pytest.raises(ValueError, match=message):
        BlockTree.from_json(text)
