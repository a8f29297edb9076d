from dataclasses import replace
from unittest import mock

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from abcd_ns.engine.render import Shot, TorchRasterizer
from abcd_ns.engine.space.influence import (
    UNSEEN,
    InfluenceTable,
    coarser,
    influence,
    overlaps,
    share_shown,
    visible_blocks,
    weights,
    worth_training,
)
from abcd_ns.engine.space.partition import build_kd
from tests.reference.scenes import random_gaussians, ring_of_views

SH_0 = 0.28209479177387814


DRAW = TorchRasterizer(use_native=False)


def painted(gaussians, chosen):
    """White where `chosen`, black elsewhere."""
    shade = torch.where(chosen, 0.5, -0.5).to(gaussians.means) / SH_0
    return replace(gaussians, features_dc=shade[:, None].expand(-1, 3).contiguous())


def test_influence_is_what_a_block_painted_white_adds_to_a_black_picture():
    gaussians, views = random_gaussians(80, seed=4, size=0.15), ring_of_views(3)
    owner = torch.arange(80) % 3
    found = influence(gaussians, owner, views, DRAW)
    for block in range(3):
        for view in views:
            small = coarser(view, 2)
            picture = DRAW(painted(gaussians, owner == block), small, sh_degree=0)
            assert found[block][view.index] == pytest.approx(float(picture.color[..., 0].mean()), abs=2e-6)


def test_large_views_are_looked_at_in_small_pictures():
    views, gaussians = ring_of_views(2, width=800, height=600), random_gaussians(20, size=0.2)
    with mock.patch.object(DRAW, "draw", wraps=DRAW.draw) as draw:
        found = influence(gaussians, torch.zeros(20, dtype=torch.int64), views, DRAW)
    shots = (shot for call in draw.call_args_list for shot in call.args[1])
    assert {(shot.crop.width, shot.crop.height) for shot in shots} == {(80, 60)}
    full = weights(gaussians, DRAW, [Shot(views[0], views[0].full)])
    assert found[0][0] == pytest.approx(float(full.sum()) / views[0].full.pixels, rel=0.02)


def test_what_stands_in_front_takes_its_share():
    gaussians, (view,) = random_gaussians(20, seed=2, size=0.2), ring_of_views(1)
    shot = Shot(view, view.full)
    (bare,) = weights(gaussians, DRAW, [shot])
    whole = share_shown(gaussians, DRAW, shot, None)
    half = share_shown(gaussians, DRAW, shot, torch.full((view.height, view.width), 0.5))
    assert whole == pytest.approx(float(bare.sum()) / view.full.pixels, abs=2e-6)
    assert half == pytest.approx(whole / 2, abs=2e-6)
    assert whole > 1e-3


def test_a_table_tells_what_was_noted_last_and_of_which_views_nothing():
    gaussians, views = random_gaussians(80, seed=4, size=0.15), ring_of_views(4)
    tree = build_kd(gaussians.means, 3)
    table = InfluenceTable(tree, range(4), {}, "cpu")
    found = weights(gaussians, DRAW, [Shot(view, view.full) for view in views])
    table.note(gaussians.means, views[1:2], 2 * found[1:2])
    table.note(gaussians.means, views[:3], found[:3])
    table.note(gaussians.means, views[3:], found[3:] * torch.nan)  # a step that was no number
    known, unknown = table.found()
    owner = tree.assign(gaussians.means)
    for view in views[:3]:
        for block in range(3):
            share = float(found[view.index][owner == block].sum()) / view.full.pixels
            assert known[block][view.index] == pytest.approx(share, abs=2e-6)
    assert unknown == {3}
    assert InfluenceTable(tree, range(4), known, "cpu").found() == (known, unknown)
    few = torch.where(owner == 1)[0]
    table.note(gaussians.means[few], views[:1], found[:1, few])  # whose blocks are looked up anew
    assert [block for block, shares in table.found()[0].items() if 0 in shares] == [1]


@given(
    st.dictionaries(st.integers(0, 99), st.floats(1e-6, 1), max_size=30), st.floats(0, 1, exclude_max=True)
)
def test_the_fewest_views_that_hold_the_share(views, share):
    kept, total = worth_training(views, share), sum(views.values())
    held = sum(views[view] for view in kept)
    assert held >= share * total * (1 - 1e-9)
    assert list(kept) == sorted(set(kept))
    if kept:
        smallest = min(views[view] for view in kept)
        assert held - smallest <= share * total * (1 + 1e-9)
        assert all(views[view] <= smallest for view in views if view not in kept)


@given(st.dictionaries(st.integers(0, 9), st.floats(0, 1), max_size=8))
def test_blocks_that_a_view_hardly_shows_are_not_visible(shares):
    influence = {block: {7: share} for block, share in shares.items()} | {10: {8: 0.1}}
    visible = visible_blocks(influence, [7], blocks=12).get(7, range(12))
    hidden = [shares.get(block, 0.0) for block in range(12) if block not in visible]
    assert 11 in visible  # nothing is known of it
    assert sum(hidden) <= UNSEEN
    if hidden:
        assert 10 not in visible
        smallest = min(shares[block] for block in visible if block in shares)
        assert max(hidden) <= smallest
        assert sum(hidden) + smallest > UNSEEN
    else:
        assert sum(shares.values()) <= UNSEEN


def test_blocks_overlap_where_the_same_views_show_them():
    influence = {0: {1: 0.2, 2: 0.4}, 1: {1: 0.1, 2: 0.2}, 2: {3: 0.5}, 3: {2: 0.3, 3: 0.4}}
    third = 0.4 * 0.3 / (0.5 * 0.2**0.5)
    for others, expected in (([1], 1.0), ([2], 0.0), ([3], third), ([1, 2, 3], 1.0 + third), ([], 0.0)):
        assert overlaps(influence, [0, 9], others) == pytest.approx([expected, 0.0], abs=1e-5)  # none sees 9
