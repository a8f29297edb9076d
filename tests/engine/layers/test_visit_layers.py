"""The layers of a visit: what is read for them, and that no room for them changes them."""

import itertools

import pytest
import torch

from abcd_ns.engine.layers.footprints import footprints
from abcd_ns.engine.layers.layer_renderer import RenderSettings
from abcd_ns.engine.layers.layer_store import LayerStore
from abcd_ns.engine.layers.visit_layers import VisitLayers
from abcd_ns.engine.render.cpu.backend import TorchRasterizer
from abcd_ns.engine.space.partition import build_kd
from tests.reference.scenes import WatchedScene, random_gaussians, renderer_of, ring_of_views

BLOCK = 5


def visit_layers(
    parts_bytes: int, device_bytes: int, backwards: bool = False
) -> tuple[VisitLayers, list[int]]:
    """Of a visit to one of 16 blocks, and the blocks that it has read so far."""
    gaussians, draw, views = random_gaussians(200, size=0.03), TorchRasterizer(), ring_of_views(6)
    scene = WatchedScene(build_kd(gaussians.means, 16), gaussians)
    own = scene.gaussians(BLOCK)
    layers = VisitLayers(
        renderer_of(scene, draw),
        LayerStore(torch.device("cpu"), device_bytes),
        footprints(own, BLOCK, views, draw),
        own,
        {view.index: view for view in views},
        RenderSettings(sh_degree=1),
        {},
        window_weight=0.05,
        parts_bytes=parts_bytes,
        backwards=backwards,
    )
    return layers, scene.read


def test_where_views_have_room_blocks_are_read_twice_at_most_for_all_of_them():
    """Once to be drawn, once for what reaches from them into others."""
    layers, read = visit_layers(parts_bytes=0, device_bytes=1 << 30)
    assert len(list(layers.draw(range(6)))) == 6
    assert len(read) > 0
    assert max(read.count(block) for block in range(16)) <= 2


@pytest.mark.parametrize("backwards", [False, True])
@pytest.mark.parametrize("parts_bytes", [0, 100_000])
def test_layers_are_the_same_whatever_room_there_is_and_wherever_reading_begins(parts_bytes, backwards):
    expected = list(visit_layers(1 << 30, 1 << 30)[0].draw(range(6)))
    layers, read = visit_layers(parts_bytes, device_bytes=0, backwards=backwards)
    for kept, other in zip(layers.draw(range(6)), expected, strict=True):
        assert torch.equal(kept.layers, other.layers)
        planes = [one.interleaved.planes if one.interleaved else torch.zeros(0) for one in (kept, other)]
        assert torch.equal(*planes)
    assert max(read.count(block) for block in range(16)) > 2


@pytest.mark.parametrize("backwards", [False, True])
def test_what_one_group_of_views_read_last_the_next_one_reads_first(backwards):
    layers, read = visit_layers(0, device_bytes=0, backwards=backwards)
    ends = []
    for _ in layers.draw(range(6)):
        ends.append((read[:3], read[-3:]))
        read.clear()
    assert all(set(last) & set(first) for (_, last), (first, _) in itertools.pairwise(ends))
