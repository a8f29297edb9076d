"""Layers: what they hold, and that folding them gives the picture of the whole scene (invariants 2 and 9)."""

import math

import pytest
import torch

from abcd_ns.engine.layers.compositing import fold
from abcd_ns.engine.layers.layer_renderer import RenderSettings, Seen
from abcd_ns.engine.render import Raster, Shot
from abcd_ns.engine.render.cpu.backend import TorchRasterizer
from abcd_ns.engine.space.intervals import ray_interval
from abcd_ns.engine.space.partition import build_grid, build_kd
from abcd_ns.engine.store.scene import MemoryScene
from abcd_ns.engine.types import Gaussians, Layer, View
from tests.reference.scenes import random_gaussians, renderer_of, ring_of_views

DRAW = TorchRasterizer()
PRIMITIVES = ["3dgs", "2dgs"]
DRAWS = {(p, side): TorchRasterizer(tile_side=side, primitive=p) for p in PRIMITIVES for side in (1, 4, 16)}
"""Rasterizers by primitive, and by the side of their tiles, and so of their windows."""
SETTINGS = RenderSettings(sh_degree=1)


def merged(gaussians: Gaussians, view: View, draw=DRAW) -> Layer:
    with torch.no_grad():
        return draw(gaussians, view, sh_degree=1).layer


def difference(a: Layer | Raster, b: Layer) -> float:
    return max(float((a.color - b.color).abs().max()), float((a.transmittance - b.transmittance).abs().max()))


def views_in_and_out(dtype) -> list[View]:
    """A camera outside the scene, and one that stands among the Gaussians."""
    size = {"width": 32, "height": 24, "dtype": dtype}
    return [*ring_of_views(1, **size), *ring_of_views(1, radius=0.7, **size)]


def translucent(count: int, size: float = 0.1, dtype=torch.float64) -> Gaussians:
    """So thin that no pixel reaches T <= 1e-4, where drawing stops: the merged picture stops for the whole
    ray, a layer for its own part of it, and the two may then differ by as much as is left out, 1e-4."""
    gaussians = random_gaussians(count, size=size, dtype=dtype)
    gaussians.opacities[:] -= 2.5
    return gaussians


CUTS = {
    "kd": lambda means: build_kd(means, 7),
    "thin": lambda means: build_grid(means, counts=(6, 1, 1)),
    "some empty": lambda means: build_grid(means, counts=(2, 2, 2)).split(0, axis=2, threshold=-50.0),
}


@pytest.mark.parametrize(
    ("primitive", "dtype", "tolerance", "side", "kind", "pass_gaussians"),
    [
        ("3dgs", torch.float64, 1e-12, 1, "kd", 0),
        ("3dgs", torch.float64, 1e-12, 4, "kd", 40),
        ("3dgs", torch.float64, 1e-12, 16, "thin", 1000),
        ("3dgs", torch.float32, 1e-6, 4, "kd", 0),
        ("2dgs", torch.float64, 1e-12, 4, "some empty", 0),
        ("2dgs", torch.float64, 1e-12, 16, "thin", 0),
    ],
)
def test_folding_cells_by_fragments_gives_the_merged_picture(
    primitive, kind, dtype, tolerance, side, pass_gaussians
):
    """With oversized Gaussians, and some far away that reach into many cells."""
    gaussians = translucent(100, 0.12, dtype)
    tree = CUTS[kind](gaussians.means)
    gaussians.scales[:3] = math.log(1.5)
    gaussians.means[3:6] *= 40.0
    gaussians.scales[3:6] = math.log(8.0)
    views, draw = views_in_and_out(dtype), DRAWS[primitive, side]
    renderer = renderer_of(MemoryScene(tree, gaussians), draw, pass_gaussians=pass_gaussians)
    assert (len(renderer.nodes()) == 1) == (pass_gaussians >= 100)
    for view in views:
        assert difference(renderer.picture(view, SETTINGS), merged(gaussians, view, draw)) < tolerance


def test_folding_by_means_is_the_block_major_picture_not_the_merged_one():
    gaussians = random_gaussians(200, size=0.15, dtype=torch.float64)
    (view,) = ring_of_views(1, dtype=torch.float64)
    tree = build_kd(gaussians.means, 6)
    renderer = renderer_of(MemoryScene(tree, gaussians), DRAW, ownership="means")
    owner = tree.assign(gaussians.means)
    color, light = torch.zeros(36, 48, 3, dtype=torch.float64), torch.ones(36, 48, dtype=torch.float64)
    for node in renderer.order(renderer.nodes(), view):
        (block,) = tree.leaves(node)
        layer = merged(gaussians[owner == block], view)
        color, light = color + light[..., None] * layer.color, light * layer.transmittance
    assert difference(renderer.picture(view, SETTINGS), Layer(color, light)) < 1e-12
    assert difference(Layer(color, light), merged(gaussians, view)) > 1e-3


@pytest.mark.parametrize(
    ("primitive", "pass_gaussians", "side"), [("3dgs", 0, 4), ("3dgs", 1000, 4), ("2dgs", 40, 16)]
)
def test_front_inside_and_back_are_everything_but_the_active_block(primitive, pass_gaussians, side):
    """Wherever the window lies, and however many nodes share the frozen blocks."""
    gaussians = translucent(100)
    views = views_in_and_out(torch.float64)
    tree = build_kd(gaussians.means, 8)
    owner = tree.assign(gaussians.means)
    own, frozen = gaussians[owner == 3], gaussians[owner != 3]
    draw = DRAWS[primitive, side]
    renderer = renderer_of(MemoryScene(tree, gaussians), draw, pass_gaussians=pass_gaussians)
    nodes = renderer.nodes(exclude=3)
    shown = renderer.shown(nodes, [(view, view.full) for view in views], exclude=3)
    loaded = {node: renderer.load(shown[node]) for node in nodes}
    for view in views:
        windows = [
            ray_interval(tree.cell(3).grown(0.2), view, draw.window_grid(view.full)),
            next(draw.depth_windows(own, [Shot(view, view.full)], visible=0.05)),
        ]
        for window in windows:
            seen = Seen(view, view.full, window)
            parts = {}
            for node in nodes:
                parts[node] = next(renderer.render(node, loaded[node], [seen], SETTINGS, 3))
                renderer.fold_up(parts, node, seen)
            cut = renderer.fold(parts, view, view.full)
            if cut.inside is not None:
                assert cut.inside.planes.unique(dim=1).shape == cut.inside.planes.shape
            with torch.no_grad():
                (inside,) = draw.draw(own[:0], [Shot(view, view.full, cut.inside, window)], sh_degree=1)
            layers = (cut.front, inside.layer, cut.back)
            assert difference(fold(list(layers)), merged(frozen, view, draw)) < 1e-12
