"""gsplat's CUDA kernels against the torch backend: forward, gradient, crops, frozen Gaussians, absgrad."""

import pytest
import torch

from abcd_ns.engine.rasterizer import TorchRasterizer, make_rasterizer
from abcd_ns.engine.types import PARAM_NAMES, Crop, Gaussians, View
from tests.engine.rasterizer_scenes import (
    as_leaves,
    gradients,
    probe,
    random_gaussians,
    relative_error,
    small_view,
    stacked,
)

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device"),
]
WIDTH, HEIGHT = 150, 100
CROPS = [None, Crop(16, 32, 64, 48), Crop(37, 5, 70, 61)]


@pytest.fixture(scope="module")
def gsplat_rasterizer():
    return make_rasterizer("gsplat", "cuda")  # runs the self-check


def scene(n: int, seed: int = 0) -> Gaussians:
    return random_gaussians(n, seed, dtype=torch.float32).to("cuda")


def view() -> View:
    return small_view(WIDTH, HEIGHT, dtype=torch.float32).to("cuda")


@pytest.mark.parametrize("crop", CROPS)
@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("with_frozen", [False, True])
def test_equals_the_torch_backend(gsplat_rasterizer, crop, antialiased, with_frozen):
    frozen = scene(100, seed=3) if with_frozen else None
    options = {"sh_degree": 3, "crop": crop, "antialiased": antialiased, "frozen": frozen}
    image, grads = gradients(lambda g: gsplat_rasterizer(g, view(), **options), scene(300))
    torch_rasterizer = TorchRasterizer("never")
    expected, expected_grads = gradients(lambda g: torch_rasterizer(g, view(), **options), scene(300))
    # A fragment at the 1/255 threshold may fall on either side: rounding differs, so a few pixels may too.
    difference = (image - expected).abs() / expected.abs().amax()
    assert difference.mean() < 1e-5
    assert difference.max() < 5e-3
    for name in PARAM_NAMES:
        assert relative_error(grads[name], expected_grads[name]) < 1e-2, name


@pytest.mark.parametrize("crop", CROPS[1:])
def test_crop_is_the_crop_of_the_full_image(gsplat_rasterizer, crop):
    gaussians = scene(500)
    full, part = (gsplat_rasterizer(gaussians, view(), sh_degree=3, crop=c) for c in (None, crop))
    torch.testing.assert_close(stacked(part), stacked(full)[crop.slices], rtol=1e-4, atol=1e-4)
    assert torch.equal(part.info["radii"], full.info["radii"])


@pytest.mark.parametrize("crop", CROPS)
def test_absgrad_and_means2d_gradient(gsplat_rasterizer, crop):
    infos = []
    for rasterizer in (gsplat_rasterizer, TorchRasterizer("never")):
        raster = rasterizer(
            as_leaves(scene(200)), view(), sh_degree=1, crop=crop, frozen=scene(50, seed=3), absgrad=True
        )
        raster.info["means2d"].retain_grad()
        weights = probe(*raster.transmittance.shape, dtype=torch.float32).to("cuda")
        (stacked(raster) * weights).sum().backward()
        infos.append(raster.info["means2d"])
    assert infos[0].absgrad.shape == infos[1].absgrad.shape == (1, 200, 2)
    assert relative_error(infos[0].absgrad, infos[1].absgrad) < 1e-2
    assert relative_error(infos[0].grad, infos[1].grad) < 1e-2


def test_graph_is_freed_without_a_backward_pass(gsplat_rasterizer):
    def draw():
        return gsplat_rasterizer(as_leaves(scene(2000)), view(), sh_degree=3, crop=CROPS[1], absgrad=True)

    draw()
    torch.cuda.synchronize()
    before = torch.cuda.memory_allocated()
    for _ in range(5):
        draw()
    assert torch.cuda.memory_allocated() <= before


def test_nothing_to_draw(gsplat_rasterizer):
    raster = gsplat_rasterizer(Gaussians.empty(device="cuda"), view(), sh_degree=3)
    assert (raster.transmittance == 1).all()


def test_nothing_in_the_crop(gsplat_rasterizer):
    behind = scene(5)
    behind = Gaussians(means=behind.means - 100, **{n: v for n, v in behind.items() if n != "means"})
    raster = gsplat_rasterizer(as_leaves(behind), view(), sh_degree=3, crop=CROPS[1])
    stacked(raster).sum().backward()
    assert (raster.transmittance == 1).all()
