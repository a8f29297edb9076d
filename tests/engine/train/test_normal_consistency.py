"""2DGS's normal consistency: of a scene at once, of a block between its layers, and what it is good for."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from abcd_ns.engine.layers.compositing import empty_layer
from abcd_ns.engine.layers.painter import FrozenLayers
from abcd_ns.engine.render.cpu.backend import TorchRasterizer
from abcd_ns.engine.render.z_window import ZWindow
from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.train.density.control import DensityConfig
from abcd_ns.engine.train.step.batch import Sample
from abcd_ns.engine.train.step.normal_consistency import (
    GRAZING,
    normal_consistency,
    planes_of,
    planes_seen,
)
from abcd_ns.engine.train.training_loop import train
from abcd_ns.engine.types import Crop, Gaussians, Layer, View
from abcd_ns.errors import UserError
from tests.reference.naive_rasterizer import rotation
from tests.reference.rasterizer_scenes import as_leaves
from tests.reference.scenes import Photos, make_coordinator, random_gaussians, ring_of_views, whole_scene

SCENE = random_gaussians(30, size=0.4, dtype=torch.float64)
VIEW = ring_of_views(3, width=16, height=12, dtype=torch.float64)[1]
DRAW = TorchRasterizer(primitive="2dgs")


def sample_of(crop: Crop = VIEW.full, view: View = VIEW, **parts) -> Sample:
    given = {"layers": None, "window": None, "background": torch.zeros(3), **parts}
    return Sample(view, crop, **given)


def naive(scene: Gaussians, crop: Crop, in_front: torch.Tensor) -> float:
    """The sum over pixels and fragments, one by one."""
    turn, center, K = VIEW.viewmat[:3, :3].numpy(), VIEW.center.numpy(), VIEW.K.numpy()
    offsets = (scene.means.numpy() - center) @ turn.T
    normals = np.stack([turn @ rotation(quat)[:, 2].numpy() for quat in scene.quats])
    # Each surfel drawn alone says what its alpha is.
    alone = [DRAW(scene[k : k + 1], VIEW, sh_degree=0, crop=crop).transmittance for k in range(len(scene))]
    order, points, mean, alphas = np.argsort(offsets[:, 2]), {}, {}, {}
    for y, x in itertools.product(range(crop.height), range(crop.width)):
        ray = np.linalg.solve(K, [crop.x + x + 0.5, crop.y + y + 0.5, 1.0])
        left, total, planes = 1.0, 0.0, np.zeros(3)
        for k in order:
            alpha = 1 - float(alone[k][y, x])
            away, least = normals[k] @ offsets[k], GRAZING * np.linalg.norm(offsets[k])
            plane = np.sign(away) * normals[k] / max(abs(away), least)
            if abs(away) > least:
                assert plane @ offsets[k] == pytest.approx(1)
            planes += left * alpha * plane
            total += left * alpha * (plane @ ray)  # one over the depth at which the ray meets the plane
            left *= 1 - alpha
        alphas[x, y], mean[x, y] = 1 - left, planes / np.linalg.norm(planes)
        if left < 0.5 and total > 0:
            points[x, y] = ray * (1 - left) / total
    found = 0.0
    for x, y in points:
        beside = [(x + 1, y), (x - 1, y), (x, y + 1), (x, y - 1)]
        if all(pixel in points for pixel in beside):
            right, left, below, above = (points[pixel] for pixel in beside)
            facing = np.cross(below - above, right - left)
            off = 1 + mean[x, y] @ facing / np.linalg.norm(facing)
            found += float(in_front[y, x]) * alphas[x, y] * off
    return found / VIEW.full.pixels


@pytest.mark.parametrize("crop", [VIEW.full, Crop(5, 3, 11, 9)])
def test_it_is_that_of_a_loop_over_fragments(crop):
    front = torch.linspace(0.2, 1, crop.pixels, dtype=torch.float64).view(crop.height, crop.width)
    nothing = Layer(torch.zeros(crop.height, crop.width, 3), front)
    given = sample_of(crop, layers=FrozenLayers(nothing, nothing))
    expected = naive(SCENE, crop, front)
    assert expected > 0.003
    assert float(normal_consistency(SCENE, [given], DRAW)) == pytest.approx(expected, rel=1e-6)
    half = replace(given, share=0.5)  # one of two parts that might have been drawn
    assert float(normal_consistency(SCENE, [given, half], DRAW)) == pytest.approx(1.5 * expected, rel=1e-6)


def test_its_gradient_is_that_of_differences():
    leaves = as_leaves(SCENE)
    normal_consistency(leaves, [sample_of()], DRAW).backward()
    generator, step = torch.Generator().manual_seed(0), 1e-6
    for name in ("means", "quats", "scales", "opacities"):
        values, found = getattr(SCENE, name), getattr(leaves, name).grad
        way = torch.randn(values.shape, generator=generator, dtype=values.dtype)
        ends = [replace(SCENE, **{name: values + sign * step * way}) for sign in (1, -1)]
        high, low = (float(normal_consistency(end, [sample_of()], DRAW)) for end in ends)
        assert float((found * way).sum()) == pytest.approx((high - low) / (2 * step), rel=1e-4, abs=1e-8)
    assert leaves.features_dc.grad is None


def test_a_block_among_others_has_what_it_has_in_the_whole_scene():
    """Where those are sorted in with it: value, and gradient of what is its own."""
    own, other = SCENE[:20], SCENE[20:]
    whole, leaves = as_leaves(SCENE), as_leaves(own)
    expected = normal_consistency(whole, [sample_of()], DRAW)
    window = ZWindow.everything(DRAW.window_grid(VIEW.full), torch.device("cpu"), torch.float64)
    nothing = empty_layer(VIEW.height, VIEW.width, dtype=torch.float64)
    given = sample_of(layers=FrozenLayers(nothing, nothing, DRAW.project(other, VIEW)), window=window)
    found = normal_consistency(leaves, [given], DRAW)
    torch.testing.assert_close(found, expected)
    (found + expected).backward()
    for name in ("means", "quats", "scales", "opacities"):
        torch.testing.assert_close(getattr(leaves, name).grad, getattr(whole, name).grad[:20])


def test_a_view_knows_the_planes_of_what_it_sees():
    for view in ring_of_views(3, dtype=torch.float64):
        seen = DRAW.project(SCENE, view)
        assert bool((seen.radii > 0).all())
        torch.testing.assert_close(planes_seen(seen, view), planes_of(SCENE, view))


def wall(tilt: float, *, about: float = 0.0, count: int = 12) -> Gaussians:
    """Large discs of all colours on a plane.

    Args:
        tilt: of the plane, about x, radians.
        about: how far the discs are turned off it, at random.
    """
    generator, pose = (
        torch.Generator().manual_seed(4),
        torch.tensor([math.cos(tilt / 2), math.sin(tilt / 2), 0, 0]),
    )
    u, v = torch.meshgrid(torch.linspace(-1.5, 1.5, count), torch.linspace(-1.5, 1.5, count), indexing="ij")
    plane = torch.stack((u.flatten(), v.flatten(), torch.zeros(count**2)), dim=1)
    return Gaussians(
        means=plane @ rotation(pose).T,
        scales=torch.tensor([-1.8, -1.8, -14.0]).repeat(count**2, 1),
        quats=pose + about * torch.randn((count**2, 4), generator=generator),
        features_dc=torch.randn((count**2, 3), generator=generator),
        features_rest=torch.zeros(count**2, 3, 3),
        opacities=torch.full((count**2, 1), 2.0),
    )


def test_discs_of_a_plane_are_consistent_however_it_is_seen():
    """With depths of their middles, the surface of a plane that is seen from the side would have steps."""
    (view,) = before_the_wall(1)
    given = sample_of(view.full, view)
    for tilt in (0.0, 0.6, 1.1):
        assert float(normal_consistency(wall(tilt), [given], DRAW)) < 1e-5
        assert float(normal_consistency(wall(tilt, about=0.15), [given], DRAW)) > 1e-3


def before_the_wall(count: int) -> list[View]:
    views = ring_of_views(1, width=48, height=36)
    pose = torch.eye(4)
    pose[2, 3] = 2.5
    shifts = torch.linspace(-0.5, 0.5, count)
    move = torch.tensor([1.0, 0.6, 0.0])
    moved = [pose.clone() for _ in range(count)]
    for each, shift in zip(moved, shifts, strict=True):
        each[:3, 3] += shift * move
    return [replace(views[0], viewmat=each, index=k) for k, each in enumerate(moved)]


def inconsistency(scene: Gaussians, views: list[View]) -> float:
    return float(normal_consistency(scene, [sample_of(view.full, view) for view in views], DRAW))


@pytest.mark.parametrize("blocks", [1, 2])
def test_surfels_of_a_wall_come_to_be_consistent(tmp_path, blocks):
    views, bumpy = before_the_wall(4), wall(0.6, about=0.15)
    photos, left = Photos(wall(0.6), views), {}
    for weight in (0.0, 0.5):
        (tmp_path / str(weight)).mkdir()
        made = make_coordinator(
            tmp_path / str(weight),
            bumpy,
            views,
            blocks=blocks,
            steps=60,
            primitive="2dgs",
            normal_consistency=weight,
            background="black",
            density=DensityConfig(strategy="off"),
            warmup=0.0,
            coarse=0.0,
        )
        train(made, photos)
        left[weight] = inconsistency(whole_scene(made), views)
    assert left[0.5] < 0.7 * left[0.0], left


def test_it_is_refused_where_there_are_no_surfels():
    with pytest.raises(UserError, match="primitive 2dgs"):
        TrainingConfig(normal_consistency=0.05).check()
    TrainingConfig(normal_consistency=0.05, primitive="2dgs").check()
