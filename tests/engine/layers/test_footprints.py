"""Where a block is in its views' images: all of it, or what holds most of its weight."""

import torch
from hypothesis import given
from hypothesis import strategies as st

from abcd_ns.engine.layers.footprints import CROP_MARGIN, extent_of_most, footprints
from abcd_ns.engine.render import TorchRasterizer
from abcd_ns.engine.types import Gaussians, View
from tests.engine.space.test_tree import SEEDS
from tests.reference.scenes import random_gaussians, ring_of_views

DRAW = TorchRasterizer()


@given(SEEDS, st.integers(1, 12), st.integers(1, 9), st.floats(0.0, 1.0))
def test_beyond_each_side_lies_a_quarter_of_what_may_be_missed_and_one_step_more_is_too_much(
    seed, width, height, share
):
    generator = torch.Generator().manual_seed(seed)
    weight = torch.rand(height, width, generator=generator, dtype=torch.float64) ** 4
    spared = (1 - share) / 4 * float(weight.sum())
    left, top, right, bottom = map(int, extent_of_most(weight, share).tolist())
    beyond = (weight[:, :left], weight[:top], weight[:, right:], weight[bottom:])
    more = (weight[:, : left + 1], weight[: top + 1], weight[:, right - 1 :], weight[bottom - 1 :])
    for missed, next_ones in zip(beyond, more, strict=True):
        assert float(missed.sum()) <= spared + 1e-12
        assert float(next_ones.sum()) > spared - 1e-12
    if share > 0.5:
        assert float(weight[top:bottom, left:right].sum()) >= share * float(weight.sum()) - 1e-12


def test_a_faint_and_wide_one_does_not_make_the_crop_the_image():
    views = ring_of_views(3, width=320, height=240)
    cluster, veil = random_gaussians(60, seed=1, size=0.05), random_gaussians(1, size=1.0)
    cluster.means[:] *= 0.2
    veil.opacities[:] = -5.3
    block = Gaussians.cat([cluster, veil])
    whole, most = (footprints(block, 0, views, DRAW, share).crops for share in (1.0, 0.9))
    for view in views:
        shown = 1 - DRAW(block, view, sh_degree=0).transmittance
        held = float(shown[most[view.index].slices].sum())
        assert whole[view.index] == view.full
        assert most[view.index].pixels < 0.5 * view.full.pixels
        assert held >= 0.9 * float(shown.sum())


def test_what_no_small_picture_shows_keeps_all_that_it_may_touch():
    """A view that sees a block is not lost, however faint the block is there."""
    views = ring_of_views(2, width=160, height=120)
    block = random_gaussians(5, size=0.2)
    block.opacities[:] = -30.0
    assert footprints(block, 0, views, DRAW, 0.995) == footprints(block, 0, views, DRAW)


def test_no_crop_is_empty_where_small_pictures_show_other_gaussians():
    """A small picture is blurred: it shows one just above the image, and not the faint one within."""
    view = View(torch.eye(4), torch.tensor([[160.0, 0, 80], [0, 160, 60], [0, 0, 1]]), 160, 120)
    block = random_gaussians(2, size=1e-4)
    pixels = torch.tensor([[80.0, -2.2], [80.0, 100.0]])
    block.means[:] = torch.cat(((pixels - view.K[:2, 2]) / 80, torch.full((2, 1), 2.0)), dim=1)
    block.opacities[:] = torch.tensor([[9.0], [-30.0]])
    assert footprints(block, 0, [view], DRAW, 0.995) == footprints(block, 0, [view], DRAW)


def test_crops_have_room_for_the_windows_of_ssim():
    (view,) = ring_of_views(1, width=320, height=240)
    block = random_gaussians(60, seed=1, size=0.02)
    block.means[:] *= 0.1
    shown = (1 - DRAW(block, view, sh_degree=0).transmittance) > 1e-3
    rows, columns = torch.where(shown)
    crop = footprints(block, 0, [view], DRAW, 0.999).crops[view.index]
    ends = (
        (crop.x, crop.x + crop.width, view.width, columns),
        (crop.y, crop.y + crop.height, view.height, rows),
    )
    for first, last, size, shows in ends:
        low, high = (int(shows.float().quantile(share)) for share in (0.01, 0.99))
        assert 0 < first <= low - CROP_MARGIN
        assert high + CROP_MARGIN <= last < size
