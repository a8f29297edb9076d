"""Blocks that are out at once make good, all together, what is missing, and no more."""

from dataclasses import replace
from functools import partial

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from abcd_ns.cluster.shared_residual import FAINT, SharedResidual, shares, shown_beside
from abcd_ns.engine.render import Shot, TorchRasterizer
from abcd_ns.engine.train.step.layer_source import LayerRoom
from abcd_ns.engine.train.training_loop import train
from tests.cluster.conftest import in_process
from tests.reference.scenes import STILL, equal, whole_scene

INFLUENCE = st.dictionaries(
    st.integers(0, 5), st.dictionaries(st.integers(0, 3), st.floats(1e-6, 1), max_size=4), max_size=6
)


@given(own=st.floats(0, 1), more=st.floats(0, 1), beside=st.floats(0, 1))
def test_who_is_alone_makes_good_all_of_it_and_others_the_less_the_more_are_out(own, more, beside):
    whole = torch.tensor([[own + more]])
    one, other = (float(shares(torch.tensor([[own]]), whole, by)) for by in (beside, beside / 2))
    assert 0 < one <= other <= 1
    assert float(shares(torch.tensor([[own]]), whole, 0.0)) == 1


@given(influence=INFLUENCE, others=st.sets(st.integers(1, 5)))
def test_the_part_that_is_out_is_that_of_influence_without_the_block_itself(influence, others):
    found = shown_beside(influence, 0, others, 6, range(4))
    assert all(0 < part <= 1 for part in found.values())
    for view in range(4):
        known = [influence.get(block, {}).get(view, 0.0) for block in range(1, 6)]
        out = [known[block - 1] for block in others]
        part = sum(out) / sum(known) if sum(known) else len(others) / 5
        assert found.get(view, 0.0) == pytest.approx(part)
    assert shown_beside(influence, 0, set(), 6, range(4)) == {}
    every = shown_beside(influence, 0, set(range(1, 6)), 6, range(4))
    assert every == pytest.approx(dict.fromkeys(range(4), 1.0))


def test_all_blocks_begin_with_the_picture_of_the_whole_scene_and_share_it(make, views, monkeypatch):
    begun, draw = {}, SharedResidual._draw

    def watched(shared, own, view):
        found = draw(shared, own, view)
        block = shared._run.active.geometry.block
        sample = shared._training.whole(view)
        if (block, view) not in begun:
            begun[block, view] = sample, found[0].float(), shared._degree
        return found

    monkeypatch.setattr(SharedResidual, "_draw", watched)
    run = make(workers=6, lag=6, density=STILL, window_weight=0.0)
    scene, blocks = whole_scene(run), run.scene.tree.num_blocks
    run._assign()
    while run._in_flight[-1].outcome is None:
        run._listen()
    assert {block for block, _ in begun} == set(range(blocks))
    for view in views:
        summed = torch.zeros(view.height, view.width)
        for (_, index), (sample, found, degree) in begun.items():
            if index == view.index:
                (merged,) = TorchRasterizer().draw(scene, [Shot(view, sample.crop)], sh_degree=degree)
                raster = replace(merged, color=found[..., :3], transmittance=found[..., 3])
                on = merged.color + merged.transmittance[..., None] * sample.background
                assert torch.allclose(sample.picture(raster), on.clamp(0, 1), atol=1e-3)
                summed[sample.crop.slices] += found[..., 4]
        (merged,) = TorchRasterizer().draw(scene, [Shot(view, view.full)], sh_degree=0)
        off = summed[merged.transmittance < 0.5] - 1
        assert 0 < float(off.min()) <= float(off.max()) < 2 * blocks * FAINT


def test_with_no_room_pictures_are_drawn_when_they_are_asked_for(make, photos):
    scenes = []
    for name, room in (("kept", LayerRoom()), ("drawn", LayerRoom(0))):
        workers = partial(in_process, photos=photos, count=3, layer_room=room)
        run = make(name, workers=workers, lag=3, density=STILL, steps=30)
        train(run, photos)
        scenes.append(whole_scene(run))
    assert equal(*scenes)
