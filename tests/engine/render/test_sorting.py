"""Sorting by radix: the order of a stable sort, whatever the number of keys."""

import pytest
import torch

from abcd_ns.engine.render.cpu.binning import RADIX, WORTH_RADIX, by_depth, by_tile, sorted_keys

COUNTS = pytest.mark.parametrize("count", [0, 1, WORTH_RADIX, WORTH_RADIX + 1, RADIX - 1, RADIX, RADIX + 1])


@COUNTS
@pytest.mark.parametrize("dtype", [torch.int16, torch.int32])
def test_keys_are_sorted_as_by_a_stable_sort(count, dtype):
    largest = torch.iinfo(dtype).max
    keys = torch.randint(0, 50, (count,), dtype=dtype)
    keys[: count // 7] = largest  # as what fills up to RADIX
    found, order = sorted_keys(keys)
    expected = sorted(range(count), key=lambda k: int(keys[k]))
    assert order.tolist() == expected
    assert torch.equal(found, keys[expected])


@pytest.mark.parametrize("tiles", [1, 32_767, 32_768, 106_800])
def test_tiles_are_sorted_however_many_there_are(tiles):
    tile = torch.randint(0, tiles, (5000,))
    tile[0] = tiles - 1
    found, order = by_tile(tile, tiles)
    expected = tile.sort(stable=True)
    assert torch.equal(found.long(), expected.values)
    assert torch.equal(order, expected.indices)


@COUNTS
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_depths_are_sorted_as_by_a_stable_sort(count, dtype):
    depths = (torch.rand(count, dtype=dtype) * 30).exp()
    depths[::3] = depths[:1].clone()  # ties
    found, order = by_depth(depths)
    expected = depths.sort(stable=True)
    assert torch.equal(found, expected.values)
    assert torch.equal(order, expected.indices)
