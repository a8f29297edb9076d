"""Whole pictures, drawn node by node, and their gradient by the pose."""

from dataclasses import replace

import pytest
import torch

from abcd_ns.engine.layers.layer_renderer import RenderSettings
from abcd_ns.engine.layers.whole_pictures import WholePictures
from abcd_ns.engine.render.cpu.backend import TorchRasterizer
from abcd_ns.engine.train.capture.poses import by_step, turned
from tests.reference.scenes import random_gaussians, renderer_of, ring_of_views

SCENE = random_gaussians(60, size=0.15, dtype=torch.float64)
VIEWS = ring_of_views(3, dtype=torch.float64)


def weights_for(view):
    generator = torch.Generator().manual_seed(view.index)
    return torch.randn(view.height, view.width, 3, generator=generator, dtype=torch.float64)


@pytest.mark.parametrize("pass_gaussians", [0, 1000])
def test_pictures_and_gradients_of_poses_are_those_of_the_merged_picture(pass_gaussians):
    """By differences of the picture that is drawn at once, for each way in which a camera may move."""
    draw, seen = TorchRasterizer(), []
    renderer = renderer_of(SCENE, draw, pass_gaussians=pass_gaussians)
    pictures = WholePictures(renderer, RenderSettings(sh_degree=1))

    def assert_merged(view, picture):
        merged = draw(SCENE, replace(view, viewmat=view.viewmat.detach()), sh_degree=1)
        for name in ("color", "transmittance", "depth"):
            assert torch.allclose(getattr(picture, name), getattr(merged, name), atol=1e-3), name

    def gradient(view, picture):
        assert_merged(view, picture)
        seen.append(view.index)
        return weights_for(view)

    def loss(view, step):
        moved = replace(view, viewmat=turned(view.viewmat, step))
        return float((draw(SCENE, moved, sh_degree=1).color * weights_for(view)).sum())

    for view, picture in zip(VIEWS, pictures.draw(VIEWS), strict=True):
        assert_merged(view, picture)
    found = pictures.differentiate(VIEWS, gradient)
    assert seen == [0, 1, 2]
    for view, matrix in zip(VIEWS, found, strict=True):
        steps = 1e-6 * torch.eye(6, dtype=torch.float64)
        expected = torch.tensor([(loss(view, step) - loss(view, -step)) / 2e-6 for step in steps])
        assert torch.allclose(by_step(matrix, view.viewmat).float(), expected, rtol=2e-3, atol=2e-2)
        assert float(expected.abs().min()) > 0.1
