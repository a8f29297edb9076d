"""The public `rasterization`, by gsplat 1.4.0's signature, against the naive twin and on a device."""

import inspect
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import gsplat
import pytest
import torch

from abcd_ns import rasterization
from abcd_ns.engine.kernels.native import library
from abcd_ns.engine.render import Shot, TorchRasterizer
from abcd_ns.engine.render.rasterization import FIXED
from abcd_ns.engine.types import PARAM_NAMES, Gaussians, View
from tests.reference.gsplat_stand_ins import lent
from tests.reference.naive_rasterizer import naive_rasterize
from tests.reference.rasterizer_scenes import gradients, random_gaussians, relative_error, small_view
from tests.reference.simulated_device import DEVICE, simulated_device

VIEWS = (small_view(), replace(small_view(), viewmat=torch.eye(4, dtype=torch.float64)))


def drawn(gaussians: Gaussians, views=VIEWS, sh_degree: int | None = 2, **options):
    """By `rasterization`, with activated values as gsplat takes them."""
    colors = torch.cat((gaussians.features_dc[:, None], gaussians.features_rest), dim=1)
    if sh_degree is None:
        colors = (0.28209479177387814 * gaussians.features_dc + 0.5).clamp_min(0)
    looks = gaussians.scales.exp(), gaussians.opacities[:, 0].sigmoid(), colors
    cameras = torch.stack([view.viewmat for view in views]), torch.stack([view.K for view in views])
    given = gaussians.means, gaussians.quats, *looks, *cameras, views[0].width, views[0].height
    return rasterization(*given, sh_degree=sh_degree, **options)


def as_raster(gaussians: Gaussians, view: View, **options) -> SimpleNamespace:
    pictures, alphas, _ = drawn(gaussians, [view], render_mode="RGB+D", **options)
    color, depth = pictures[0, ..., :3], pictures[0, ..., 3]
    return SimpleNamespace(color=color, transmittance=1 - alphas[0, ..., 0], depth=depth)


@pytest.mark.parametrize(("sh_degree", "mode"), [(None, "classic"), (0, "antialiased"), (3, "classic")])
def test_picture_and_gradient_equal_the_naive_twins(sh_degree, mode):
    gaussians, view = random_gaussians(12), VIEWS[0]
    options = {"sh_degree": sh_degree or 0, "antialiased": mode == "antialiased"}
    expected, expected_grads = gradients(lambda g: naive_rasterize(g, view, **options), gaussians)
    found, grads = gradients(
        lambda g: as_raster(g, view, sh_degree=sh_degree, rasterize_mode=mode), gaussians
    )
    torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-11)
    for name in PARAM_NAMES:
        assert relative_error(grads[name], expected_grads[name]) < 1e-9, name


def test_every_mode_draws_all_cameras_on_their_backgrounds():
    gaussians, grounds = random_gaussians(12), torch.rand(2, 3, dtype=torch.float64)
    naives = [naive_rasterize(gaussians, view, sh_degree=2) for view in VIEWS]
    for mode in ("RGB", "D", "ED", "RGB+D", "RGB+ED"):
        pictures, alphas, meta = drawn(gaussians, render_mode=mode, backgrounds=grounds)
        for k, naive in enumerate(naives):
            alpha = 1 - naive.transmittance
            color = naive.color + naive.transmittance[..., None] * grounds[k]
            depth = naive.depth / alpha.clamp_min(1e-10) if "ED" in mode else naive.depth
            parts = [color] * ("RGB" in mode) + [depth[..., None]] * ("D" in mode)
            torch.testing.assert_close(pictures[k], torch.cat(parts, dim=-1), rtol=1e-9, atol=1e-10)
            torch.testing.assert_close(alphas[k, ..., 0], alpha, rtol=1e-10, atol=1e-11)
            assert meta["radii"][k].tolist() == naive.radii
    assert (meta["width"], meta["height"], meta["n_cameras"]) == (VIEWS[0].width, VIEWS[0].height, 2)


def test_gsplats_kernels_draw_the_same_on_a_device():
    gaussians, views = random_gaussians(20, dtype=torch.float32), [view.to(torch.float32) for view in VIEWS]
    expected, *_ = drawn(gaussians, views)
    with simulated_device(), lent():
        found, *_ = drawn(gaussians.to(DEVICE), [view.to(DEVICE) for view in views])
        assert found.device == DEVICE
        assert relative_error(found.cpu(), expected) < 1e-3


def test_what_is_exactly_opaque_or_flat_has_gradients():
    opaque, flat = torch.ones(1, requires_grad=True), torch.zeros(1, 3, requires_grad=True)
    view, at = small_view(dtype=torch.float32), torch.tensor([[0.0, 0.0, 4.0]])
    camera = (view.viewmat[None], view.K[None], view.width, view.height)
    pictures, _, _ = rasterization(at, torch.eye(4)[:1], flat, opaque, torch.ones(1, 3), *camera)
    pictures.sum().backward()
    assert 0 < pictures.max() <= 1
    assert opaque.grad > 0
    assert flat.grad.isfinite().all()


def test_colors_of_any_sign_are_drawn_and_have_gradients():
    """Normals are drawn as colours, and black must be able to learn."""
    given, view = random_gaussians(12), VIEWS[0]
    others = (given.means, given.quats, given.scales.exp(), given.opacities[:, 0].sigmoid())
    camera = (view.viewmat[None], view.K[None], view.width, view.height)
    colors = torch.linspace(-1, 1, 36, dtype=torch.float64).reshape(12, 3).requires_grad_()
    pictures, alphas, _ = rasterization(*others, colors, *camera)
    lighter, _, _ = rasterization(*others, colors.detach() + 2, *camera)
    torch.testing.assert_close(pictures, lighter - 2 * alphas)
    pictures.sum().backward()
    assert pictures.min() < 0
    assert relative_error(colors.grad, colors.grad[:, :1].expand(-1, 3)) < 1e-9
    black = torch.zeros(12, 3, dtype=torch.float64, requires_grad=True)
    rasterization(*others, black, *camera)[0].sum().backward()
    torch.testing.assert_close(black.grad, colors.grad)


def test_every_argument_of_gsplats_is_taken_or_refused():
    theirs = inspect.signature(gsplat.rasterization).parameters
    own = {name for name, p in inspect.signature(rasterization).parameters.items() if p.kind != p.VAR_KEYWORD}
    assert own | set(FIXED) == set(theirs)
    assert not own & set(FIXED)
    others = {name: value for name, value in FIXED.items() if name != "packed"}
    assert others == {name: theirs[name].default for name in others}
    drawn(random_gaussians(3), **FIXED)


@pytest.mark.parametrize(
    ("options", "kind", "says"),
    [
        ({"absgrad": True}, ValueError, "absgrad=True is not supported here"),
        ({"camera_model": "fisheye"}, ValueError, "camera_model=fisheye"),
        ({"ortho": True}, TypeError, "no argument ortho"),
        ({"sh_degree": 4}, ValueError, "sh_degree is 4"),
    ],
)
def test_what_is_not_supported_is_refused_in_one_line(options, kind, says):
    with pytest.raises(kind, match=says) as refused:
        drawn(random_gaussians(3), **options)
    assert "\n" not in str(refused.value)


REFUSED = """
import torch
from abcd_ns import rasterization

def says(**change):
    given = {"means": torch.ones(3, 3), "quats": torch.ones(3, 4), "scales": torch.ones(3, 3)}
    given |= {"opacities": torch.ones(3), "colors": torch.ones(3, 3)}
    given |= {"viewmats": torch.eye(4)[None], "Ks": torch.eye(3)[None], "width": 8, "height": 8}
    try:
        rasterization(**given | change)
    except ValueError as error:
        return str(error)

assert "quats must be [3, 4], not [3, 3]" in says(quats=torch.ones(3, 3))
assert "scales must be [3, 3], not [3, 1]" in says(scales=torch.ones(3, 1))
assert "opacities must be [3], not [2]" in says(opacities=torch.ones(2))
assert "colors must be [3, 3], not [2, 3]" in says(colors=torch.ones(2, 3))
assert "scales are torch.float64 on cpu" in says(scales=torch.ones(3, 3).double())
assert "colors are torch.float16 on cpu" in says(colors=torch.ones(3, 3).half())
assert "viewmats must be [4, 4, 4], not [4, 4]" in says(viewmats=torch.eye(4))
assert "Ks must be [1, 3, 3], not [3, 3]" in says(Ks=torch.eye(3))
assert "backgrounds must be [1, 3], not [3]" in says(backgrounds=torch.ones(3))
assert "backgrounds must be [1, 3], not [1, 1]" in says(backgrounds=torch.ones(1, 1))
assert "render_mode must be one of RGB, D" in says(render_mode="depth")
assert "rasterize_mode must be one of classic, antialiased, not aa" in says(rasterize_mode="aa")
"""


def test_what_would_be_read_as_something_else_is_refused():
    """The native library takes addresses: it would read past a tensor's end, or its bytes as float32. In a
    process of its own, for here types are checked."""
    done = subprocess.run([sys.executable, "-c", REFUSED], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.skipif(library() is None, reason="no C++ compiler")
def test_absolute_gradients_are_sums_over_pixels():
    gaussians, view = random_gaussians(12).to(torch.float32), small_view(19, 11, torch.float32)
    gaussians = Gaussians(**{name: value.requires_grad_() for name, value in gaussians.items()})
    torch.manual_seed(0)
    target = torch.rand(1, view.height, view.width, 3)
    pictures, _, meta = drawn(gaussians, [view], absgrad=True)
    meta["means2d"].retain_grad()
    (pictures - target).square().sum().backward()
    found, expected = meta["means2d"].absgrad, torch.zeros_like(meta["means2d"])
    for pixel in range(view.height * view.width):
        pictures, _, one = drawn(gaussians, [view])
        one["means2d"].retain_grad()
        (pictures - target).square().flatten(1, 2)[0, pixel].sum().backward()
        expected += one["means2d"].grad.abs()
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-4)
    assert (found > meta["means2d"].grad.abs() - 1e-4).all()


def test_what_is_frozen_in_another_precision_is_drawn_as_what_it_is():
    gaussians, view = random_gaussians(6).to(torch.float32), small_view(19, 11, torch.float32)
    frozen = random_gaussians(5, seed=3)
    draws, pictures = TorchRasterizer(), []
    for dtype in (torch.float32, torch.float64):
        seen = draws.project(frozen.to(dtype), view.to(dtype))
        (raster,) = draws.draw(gaussians, [Shot(view, view.full, seen)], sh_degree=0)
        pictures.append(raster.color.float())
    torch.testing.assert_close(*pictures, rtol=1e-4, atol=1e-4)
