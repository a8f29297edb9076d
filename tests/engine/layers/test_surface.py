"""Normals and median depth of a whole scene, at once and unit by unit."""

from dataclasses import replace

import pytest
import torch

from abcd_ns.engine.layers.painter import Painter, PaintSettings
from abcd_ns.engine.layers.surface import colored_by_normal, median_depth, normals_in, normals_of
from abcd_ns.engine.render.cpu.backend import TorchRasterizer
from abcd_ns.engine.space.partition import build_kd
from abcd_ns.engine.store.derived_scenes import ChangedScene
from abcd_ns.engine.store.scene import MemoryScene
from abcd_ns.engine.types import Crop, Gaussians, View
from abcd_ns.viewer.pictures import BlockPictures
from tests.reference.naive_rasterizer import rotation
from tests.reference.scenes import random_gaussians, ring_of_views

SCENE = random_gaussians(60, size=0.2, dtype=torch.float64)
VIEWS = ring_of_views(3, dtype=torch.float64)
SETTINGS = PaintSettings(sh_degree=0)
PRIMITIVES = pytest.mark.parametrize("primitive", ["3dgs", "2dgs"])


def painter_of(primitive: str, pass_gaussians: int, keep=lambda gaussians: gaussians) -> Painter:
    scene = ChangedScene(MemoryScene(build_kd(SCENE.means, 4), SCENE), lambda _, found: keep(found))
    rasterizer = TorchRasterizer(primitive=primitive)
    options = {"ownership": "fragments", "pass_gaussians": pass_gaussians}
    return Painter(scene, VIEWS, rasterizer, **options)


def fragments_at(primitive: str, view: View, x: int, y: int) -> list[tuple[float, int, float]]:
    """(depth, which Gaussian, alpha) of a pixel's fragments, front to back: each Gaussian drawn alone."""
    draw, found = TorchRasterizer(primitive=primitive), []
    for k in range(len(SCENE)):
        one = draw(SCENE[k : k + 1], view, sh_degree=0, crop=Crop(x, y, 1, 1))
        alpha = 1 - float(one.transmittance)
        if alpha > 0:
            found.append((float(one.depth) / alpha, k, alpha))
    return sorted(found)


def facing(k: int, view: View, primitive: str) -> torch.Tensor:
    axis = 2 if primitive == "2dgs" else int(SCENE.scales[k].argmin())
    normal = rotation(SCENE.quats[k])[:, axis]
    return -normal if float(normal @ (SCENE.means[k] - view.center)) > 0 else normal


def drawn(primitive: str, view: View, pass_gaussians: int) -> tuple[torch.Tensor, torch.Tensor]:
    """The median depth and the normals of a picture."""
    depth = median_depth(painter_of(primitive, pass_gaussians), view, SETTINGS)
    painter = painter_of(primitive, pass_gaussians, lambda g: colored_by_normal(g, view, primitive == "2dgs"))
    assert (len(painter.units()) == 4) == (pass_gaussians == 0)
    return depth, normals_in(BlockPictures(painter, view, SETTINGS).everything())


@PRIMITIVES
def test_both_are_those_of_a_loop_over_fragments(primitive):
    """Drawn at once, and unit by unit; in pixels all over a picture."""
    view, crossed = VIEWS[1], 0
    ways = [drawn(primitive, view, pass_gaussians) for pass_gaussians in (0, 1000)]
    for x, y in ((5, 5), (18, 12), (24, 18), (29, 22), (33, 9), (20, 26)):
        left, expected, mean = 1.0, 0.0, torch.zeros(3, dtype=torch.float64)
        for z, k, alpha in fragments_at(primitive, view, x, y):
            expected = z if left > 0.5 else expected
            mean += left * alpha * facing(k, view, primitive)
            left *= 1 - alpha
        crossed += left < 0.5
        for depth, normals in ways:
            assert float(depth[y, x]) == pytest.approx(expected, abs=1e-9)
            if left < 1:
                assert torch.allclose(normals[y, x], mean / mean.norm(), atol=2e-3)
    assert crossed >= 2


@PRIMITIVES
def test_units_give_what_all_at_once_gives(primitive):
    for view in VIEWS:
        whole, parts = (median_depth(painter_of(primitive, n), view, SETTINGS) for n in (1000, 0))
        assert torch.allclose(whole, parts, atol=1e-9)
        assert float((whole > 0).double().mean()) > 0.2


def test_a_wall_has_one_normal_and_one_depth():
    """A wall of discs that face the camera, behind a thin veil that covers less than half."""
    view = replace(VIEWS[0], viewmat=torch.eye(4, dtype=torch.float64))
    grid = torch.linspace(-3, 3, 25, dtype=torch.float64)
    x, y = (value.flatten() for value in torch.meshgrid(grid, grid, indexing="xy"))

    def wall(z: float, opacity: float) -> Gaussians:
        count = len(x)
        return Gaussians(
            means=torch.stack((x, y, torch.full_like(x, z)), dim=1),
            scales=torch.tensor([-1.5, -1.5, -9.0], dtype=torch.float64).expand(count, 3),
            quats=torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand(count, 4),
            features_dc=x.new_zeros(count, 3),
            features_rest=x.new_zeros(count, 3, 3),
            opacities=x.new_full((count, 1), opacity),
        )

    scene = Gaussians.cat([wall(2.0, -5.0), wall(3.0, 3.0)])
    painter = Painter(
        MemoryScene(build_kd(scene.means, 1), scene),
        [view],
        TorchRasterizer(),
        ownership="fragments",
        pass_gaussians=10**6,
    )
    middle = (slice(12, 24), slice(16, 32))
    assert torch.allclose(median_depth(painter, view, SETTINGS)[middle], view.K.new_tensor(3.0))
    drawn = TorchRasterizer()(colored_by_normal(scene, view, flat=False), view, sh_degree=0)
    towards = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
    assert torch.allclose(normals_in(drawn)[middle], towards.expand(12, 16, 3))
    assert float((drawn.depth / (1 - drawn.transmittance))[middle].max()) < 2.99


def test_normals_face_the_camera():
    for flat in (False, True):
        normals = normals_of(SCENE, VIEWS[0].center, flat)
        assert torch.allclose(normals.norm(dim=1), torch.ones(len(SCENE), dtype=torch.float64))
        assert bool(((VIEWS[0].center - SCENE.means) * normals).sum(dim=1).ge(0).all())
