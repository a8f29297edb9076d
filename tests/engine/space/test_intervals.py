"""Intervals: along every ray the cells' windows tile camera z, with no gap or overlap, to the last bit.

Most tests look at tiles of one pixel, which are the pixels' own rays.
"""

import math
import random

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from abcd_ns.engine.render.z_window import TileGrid
from abcd_ns.engine.space.intervals import Rays, ray_directions, ray_interval, ray_intervals
from abcd_ns.engine.space.tree import BlockTree, front_to_back
from abcd_ns.engine.types import Crop, View
from tests.engine.space.test_tree import SEEDS, lattice_points, random_tree

DTYPES = st.sampled_from([torch.float32, torch.float64])


def random_view(seed: int, dtype: torch.dtype) -> View:
    """A 6x5 camera. Axis-aligned half of the time: rays then run along faces, with components exactly 0."""
    generator, rng = torch.Generator().manual_seed(seed), random.Random(seed)
    if rng.random() < 0.5:
        rotation = torch.eye(3, dtype=dtype)[torch.randperm(3, generator=generator)]
        rotation = rotation * torch.randint(0, 2, (3, 1), generator=generator).mul(2).sub(1)
    else:
        rotation = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=dtype)).Q
    center = lattice_points(seed, 1)[0].to(dtype)
    viewmat = torch.eye(4, dtype=dtype)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -(rotation @ center)
    # Principal point on a pixel's centre: that pixel's ray is the optical axis itself.
    K = torch.tensor([[4.0, 0, 2.5], [0, 5.0, 2.5], [0, 0, 1]], dtype=dtype)
    return View(viewmat, K, width=6, height=5)


def tree_around(seed: int, view: View) -> BlockTree:
    """A random tree with more planes through the camera's centre as computed, or one step beside it."""
    tree, rng = random_tree(seed, 1 + seed % 9), random.Random(seed)
    for axis, c in enumerate(view.center.tolist()):
        plane = rng.choice([c, math.nextafter(c, math.inf), math.nextafter(c, -math.inf)])
        for block in range(tree.num_blocks):
            cell = tree.cell(block)
            if cell.lower[axis] < plane < cell.upper[axis] and rng.random() < 0.7:
                tree = tree.split(block, axis, plane)
    return tree


def leaf_windows(tree: BlockTree, view: View) -> tuple[torch.Tensor, torch.Tensor]:
    """near and far of all blocks, [K, h, w]."""
    grid = TileGrid(view.full, 1)
    windows = [ray_interval(tree.cell(block), view, grid) for block in range(tree.num_blocks)]
    near, far = torch.stack([w.near for w in windows]), torch.stack([w.far for w in windows])
    return near.view(-1, view.height, view.width), far.view(-1, view.height, view.width)


@given(SEEDS, DTYPES)
def test_windows_follow_one_another_in_front_to_back_order(seed, dtype):
    """From end to end, so that exactly one cell holds any z."""
    view = random_view(seed, dtype)
    tree = tree_around(seed, view)
    near, far = leaf_windows(tree, view)
    assert near.dtype == far.dtype == dtype
    at = torch.full_like(near[0], -math.inf)
    for block in front_to_back(tree, view.center):
        met = near[block] < far[block]
        assert torch.equal(near[block][met], at[met])
        at = torch.where(met, far[block], at)
    assert bool((at == math.inf).all())


@given(SEEDS, DTYPES)
def test_the_window_is_the_one_of_the_cell_that_holds_the_point(seed, dtype):
    """Checked in float64 a little away from the planes, where rounding cannot matter."""
    view = random_view(seed, dtype)
    tree = tree_around(seed, view)
    near, far = leaf_windows(tree, view)
    z = 10 ** torch.empty(5, 6, dtype=dtype).uniform_(-2, 1, generator=torch.Generator().manual_seed(seed))
    inverse = torch.linalg.inv(view.viewmat.double())
    for row in range(5):
        for column in range(6):
            pixel = torch.tensor([column + 0.5, row + 0.5, 1.0], dtype=torch.float64)
            in_camera = torch.linalg.inv(view.K.double()) @ pixel * z[row, column]
            point = inverse[:3, :3] @ in_camera + inverse[:3, 3]
            planes = [(axis, threshold) for axis, threshold, *_ in tree.rows if axis >= 0]
            if min(abs(point[axis] - threshold) for axis, threshold in planes) < 1e-4:
                continue
            block = int(tree.assign(point[None]))
            assert near[block, row, column] <= z[row, column] < far[block, row, column]


@given(SEEDS, DTYPES, st.integers(0, 5), st.integers(0, 4), st.sampled_from([1, 2, 4]))
def test_a_crop_of_the_windows_is_the_windows_of_the_crop(seed, dtype, x, y, side):
    view = random_view(seed, dtype)
    tree, crop = tree_around(seed, view), Crop(x, y, 6 - x, 5 - y)
    for block in range(tree.num_blocks):
        whole = ray_interval(tree.cell(block), view, TileGrid(view.full, side))
        part = ray_interval(tree.cell(block), view, TileGrid(crop, side))
        assert torch.equal(part.near, whole.on(part.grid).near)
        assert torch.equal(part.far, whole.on(part.grid).far)


@given(SEEDS, DTYPES)
def test_crops_of_several_views_in_one_pass_are_each_as_alone(seed, dtype):
    views = [random_view(seed + k, dtype) for k in range(3)]
    tree = tree_around(seed, views[0])
    grids = [TileGrid(Crop(k, 0, 6 - k, 5), 1 + k) for k in range(3)]
    rays = [
        Rays.of(view, TileGrid(view.full, grid.side)).on(grid)
        for view, grid in zip(views, grids, strict=True)
    ]
    for block in range(tree.num_blocks):
        together = ray_intervals(tree.cell(block), rays)
        for view, grid, found in zip(views, grids, together, strict=True):
            alone = ray_interval(tree.cell(block), view, grid)
            assert found.grid == grid
            assert torch.equal(found.near, alone.near)
            assert torch.equal(found.far, alone.far)


@pytest.mark.parametrize("side", [2, 4])
def test_a_tile_has_the_ray_through_its_middle(side):
    view = random_view(1, torch.float64)
    grid = TileGrid(view.full, side)
    found = ray_directions(view, grid).view(3, grid.rows, grid.cols)
    for row in range(grid.rows):
        for col in range(grid.cols):
            pixel = torch.tensor([(col + 0.5) * side, (row + 0.5) * side, 1.0], dtype=torch.float64)
            expected = view.viewmat[:3, :3].T @ torch.linalg.inv(view.K) @ pixel
            torch.testing.assert_close(found[:, row, col], expected)
