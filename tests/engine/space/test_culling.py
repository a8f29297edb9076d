"""Culling by bounds: what is passed over could not have been drawn."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from abcd_ns.engine.layers.layer_renderer import LayerRenderer, RenderSettings, Seen
from abcd_ns.engine.render.cpu.backend import TorchRasterizer
from abcd_ns.engine.space.partition import build_kd
from abcd_ns.engine.space.tree import EVERYWHERE, Box
from abcd_ns.engine.space.visibility import BOUNDS_SLANT, ROUNDING, Frusta, Optics, bounds_of
from abcd_ns.engine.store.scene import MemoryScene
from abcd_ns.engine.types import Crop, Gaussians
from tests.reference.scenes import random_gaussians, ring_of_views

DRAW = TorchRasterizer()
SETTINGS = RenderSettings(sh_degree=1)


def corners(*boxes: Box) -> torch.Tensor:
    return torch.stack([torch.stack((box.lower, box.upper)) for box in boxes])


class Watched(MemoryScene):
    def __init__(self, *args):
        super().__init__(*args)
        self.read: set[int] = set()

    def gaussians(self, block):
        self.read.add(block)
        return super().gaussians(block)


@given(
    seed=st.integers(0, 10_000),
    size=st.sampled_from([0.01, 0.1, 0.6]),
    where=st.tuples(*[st.floats(-4, 4)] * 3),
    crop=st.sampled_from([None, Crop(0, 0, 16, 8), Crop(32, 16, 16, 16)]),
)
def test_what_may_not_show_draws_nothing(seed, size, where, crop):
    """Blocks beside, behind and around the cameras, inside crops and outside."""
    gaussians = random_gaussians(12, size=size, seed=seed, dtype=torch.float64)
    gaussians.means[:] = gaussians.means + torch.tensor(where, dtype=torch.float64)
    views = ring_of_views(3, dtype=torch.float64)
    seen = [(view, crop or view.full) for view in views]
    shows, crops = Frusta(seen, DRAW.slack).crops(
        corners(bounds_of(gaussians)), torch.ones(1, len(seen), dtype=torch.bool)
    )
    for (view, crop), shown in zip(seen, shows[0].tolist(), strict=True):
        drawn = DRAW(gaussians, view, crop=crop, sh_degree=0).layer
        if shown and (part := crops.get(view.index)) is not None:
            drawn.transmittance[part.within(crop).slices] = 1
        assert bool((drawn.transmittance == 1).all())


@given(seed=st.integers(0, 1000), spread=st.sampled_from([0.5, 2.0, 9.0]))
def test_frusta_hold_what_their_cameras_see(seed, spread):
    points = spread * torch.randn(5, 3, generator=torch.Generator().manual_seed(seed)).double()
    views = ring_of_views(6, dtype=torch.float64)
    rows = [4, 1, 0]
    frusta = Frusta([(view, view.full) for view in views], -ROUNDING)
    held = frusta.may_show(points[:, None].expand(-1, 2, -1), rows).any(dim=0)
    assert held.tolist() == [bool(views[row].depths_of(points)[1].any()) for row in rows]


def test_a_box_without_end_may_always_show():
    (view,) = ring_of_views(1)
    frusta = Frusta([(view, view.full)], DRAW.slack)
    assert frusta.may_show(corners(EVERYWHERE)).tolist() == [[True]]
    assert frusta.may_show(torch.zeros(0, 2, 3).double()).shape == (0, 1)
    assert Frusta([], DRAW.slack).may_show(corners(EVERYWHERE)).shape == (1, 0)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_what_is_not_finite_is_never_passed_over(bad):
    gaussians = random_gaussians(5)
    gaussians.means[2, 1] = bad
    assert bounds_of(gaussians) is EVERYWHERE
    assert bounds_of(gaussians[:0]) is None


def test_too_wide_a_lens_switches_bounds_off():
    views = ring_of_views(2)
    optics, box = Optics(views, DRAW.slack), Box(torch.zeros(3).double(), torch.ones(3).double())
    assert bool(optics.drawn_within([box]).isfinite().all())
    optics.slant = BOUNDS_SLANT + 0.1
    assert not optics.drawn_within([box]).isfinite().any()


def street(blocks: int) -> Gaussians:
    """Clusters in a row, far apart, each in a cell of its own."""
    parts = []
    for k in range(blocks):
        part = random_gaussians(10, size=0.03, seed=k, dtype=torch.float64)
        part.means[:, 0] += 40.0 * k
        parts.append(part)
    return Gaussians.cat(parts)


@pytest.mark.parametrize("ownership", ["fragments", "means"])
def test_blocks_out_of_sight_are_not_read_and_the_picture_is_the_same(ownership):
    gaussians = street(8)
    views = ring_of_views(3, dtype=torch.float64)  # around the first cluster
    tree = build_kd(gaussians.means, 8)
    scene = Watched(tree, gaussians)
    renderer = LayerRenderer(scene, DRAW, ownership=ownership, pass_gaussians=0)
    for view in views:
        found = renderer.picture(view, SETTINGS)
        expected = DRAW(gaussians, view, sh_degree=1).layer
        assert torch.allclose(found.color, expected.color, atol=1e-12)
        assert torch.allclose(found.transmittance, expected.transmittance, atol=1e-12)
    assert len(scene.read) < 8
    assert int(tree.assign(torch.zeros(1, 3))[0]) in scene.read


def test_few_parts_are_held_while_nodes_are_folded():
    gaussians, (view,) = random_gaussians(128), ring_of_views(1)
    scene, seen = MemoryScene(build_kd(gaussians.means, 32), gaussians), Seen(view, view.full)
    renderer, parts, most = LayerRenderer(scene, DRAW, ownership="means", pass_gaussians=0), {}, 0
    for node, shown in renderer.shown(renderer.nodes(0), [(view, view.full)], exclude=0).items():
        (parts[node],) = renderer.render(node, renderer.load(shown), [seen], SETTINGS, 0)
        renderer.fold_up(parts, node, seen)
        most = max(most, len(parts))
    assert list(parts) == [0]
    assert most <= 6  # one for each level of a tree of 32, and the one that came last
