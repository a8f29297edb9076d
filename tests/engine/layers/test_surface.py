"""Normals and median depth of a whole scene, at once and node by node; fog."""

from dataclasses import replace

import pytest
import torch

from abcd_ns.engine.layers.layer_renderer import RenderSettings
from abcd_ns.engine.layers.surface import NEARER, colored_by_normal, fog_in_white, median_depth, normals_in
from abcd_ns.engine.render import Raster
from abcd_ns.engine.render.cpu.backend import TorchRasterizer
from abcd_ns.engine.space.partition import build_kd
from abcd_ns.engine.store.scene import ChangedScene, MemoryScene
from abcd_ns.engine.types import View
from tests.reference.naive_rasterizer import rotation
from tests.reference.scenes import random_gaussians, renderer_of, ring_of_views

SCENE = random_gaussians(60, size=0.2, dtype=torch.float64)
VIEWS = ring_of_views(3, dtype=torch.float64)
SETTINGS = RenderSettings(sh_degree=0)
PRIMITIVES = pytest.mark.parametrize("primitive", ["3dgs", "2dgs"])


def fragments_at(alone: list[Raster], x: int, y: int) -> list[tuple[float, int, float]]:
    """(depth, which Gaussian, alpha) of a pixel's fragments, front to back, by pictures of each alone."""
    alphas = [1 - float(one.transmittance[y, x]) for one in alone]
    return sorted((float(alone[k].depth[y, x]) / alpha, k, alpha) for k, alpha in enumerate(alphas) if alpha)


def facing(k: int, view: View, primitive: str) -> torch.Tensor:
    axis = 2 if primitive == "2dgs" else int(SCENE.scales[k].argmin())
    normal = rotation(SCENE.quats[k])[:, axis]
    return -normal if float(normal @ (SCENE.means[k] - view.center)) > 0 else normal


def drawn(primitive: str, view: View, pass_gaussians: int) -> tuple[torch.Tensor, torch.Tensor]:
    """The median depth and the normals of a picture."""
    draw, scene = TorchRasterizer(primitive=primitive), MemoryScene(build_kd(SCENE.means, 4), SCENE)
    colored = ChangedScene(scene, lambda _, found: colored_by_normal(found, view, primitive == "2dgs"))
    renderers = [renderer_of(each, draw, pass_gaussians=pass_gaussians) for each in (scene, colored)]
    assert (len(renderers[0].nodes()) == 4) == (pass_gaussians == 0)
    return median_depth(renderers[0], view, SETTINGS), normals_in(renderers[1].picture(view, SETTINGS))


@PRIMITIVES
def test_both_are_those_of_a_loop_over_fragments(primitive):
    """Drawn at once, and node by node; in pixels all over a picture."""
    view, crossed = VIEWS[1], 0
    ways = [drawn(primitive, view, pass_gaussians) for pass_gaussians in (0, 1000)]
    draw = TorchRasterizer(primitive=primitive)
    alone = [draw(SCENE[k : k + 1], view, sh_degree=0) for k in range(len(SCENE))]
    for x, y in ((5, 5), (18, 12), (24, 18), (29, 22), (33, 9), (20, 26)):
        left, expected, mean = 1.0, 0.0, torch.zeros(3, dtype=torch.float64)
        for z, k, alpha in fragments_at(alone, x, y):
            expected = z if left > 0.5 else expected
            mean += left * alpha * facing(k, view, primitive)
            left *= 1 - alpha
        crossed += left < 0.5
        for depth, normals in ways:
            assert float(depth[y, x]) == pytest.approx(expected, abs=1e-9)
            if left < 1:
                assert torch.allclose(normals[y, x], mean / mean.norm(), atol=2e-3)
    assert crossed >= 2


def test_fog_is_the_weight_of_what_lies_before_the_nearest_point():
    def share(gaussians, view):
        return float(draw(fog_in_white(gaussians, view), view, sh_degree=0).color.mean())

    draw, view = TorchRasterizer(), VIEWS[0]
    z = SCENE.means @ view.viewmat[2, :3] + view.viewmat[2, 3]
    nearest = float(z.median()) / NEARER
    fog = SCENE[z < NEARER * nearest]
    alone = 1 - float(draw(fog, view, sh_degree=0).transmittance.mean())  # nothing lies before it
    assert alone > 0.02
    assert share(SCENE, replace(view, nearest=nearest)) == pytest.approx(alone, abs=1e-5)
    assert share(SCENE, view) < 1e-6  # a view that knows no point has none
    behind = replace(SCENE, means=(view.center - view.viewmat[2, :3]).expand(60, 3))
    assert share(behind, replace(view, nearest=1.0)) < 1e-6
