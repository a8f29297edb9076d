"""The native library agrees with torch on any number of threads; without it, torch draws."""

import os
import signal
import subprocess
from functools import partial
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from pytorch_msssim import ssim

from abcd_ns.engine.gaussians.adam import Adam
from abcd_ns.engine.kernels import native
from abcd_ns.engine.kernels.native import find_compiler, library
from abcd_ns.engine.kernels.photometric import SSIM_WINDOW
from abcd_ns.engine.render import CutShot, Shot, TorchRasterizer, ZWindow
from abcd_ns.engine.render.loss import photometric_loss
from abcd_ns.engine.render.projection import PRIMITIVES
from abcd_ns.engine.types import Crop
from abcd_ns.machine import threads_wanted
from tests.reference.rasterizer_scenes import (
    assert_drawn_alike,
    assert_same_layer,
    drawn,
    gradients,
    random_gaussians,
    random_window,
    relative_error,
    small_view,
    stacked,
)

VIEW = small_view(83, 61, dtype=torch.float32)
SCENE = random_gaussians(150, dtype=torch.float32)
CROP = Crop(21, 13, 62, 48)
needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C++ compiler is on the PATH")
BOTH = pytest.mark.parametrize("primitive", PRIMITIVES)
TOLERANCES = {"3dgs": (1e-5, 1e-4), "2dgs": (3e-5, 5e-4)}
"""Of pictures and of gradients in float32; a surfel divides by what may be next to nothing."""


def pair(primitive: str) -> tuple[TorchRasterizer, TorchRasterizer]:
    return tuple(TorchRasterizer(use_native=each, primitive=primitive) for each in (True, False))


@pytest.fixture
def own_library(tmp_path, monkeypatch):
    """A folder without a library, and nothing loaded."""
    monkeypatch.setenv(native.FOLDER_VARIABLE, str(tmp_path / "kernels"))
    library.cache_clear()
    yield tmp_path / "kernels"
    library.cache_clear()


@pytest.fixture
def threads():
    yield library().abcd_threads
    library().abcd_threads(threads_wanted())


@needs_compiler
@BOTH
@pytest.mark.parametrize(
    ("stored", "sh_degree", "antialiased", "crop"),
    [(3, 0, False, None), (3, 1, True, CROP), (3, 3, False, CROP), (2, 2, True, CROP), (1, 1, False, None)],
)
def test_pictures_and_gradients_are_those_of_torch(primitive, stored, sh_degree, antialiased, crop):
    scene, frozen = (random_gaussians(n, n, stored, torch.float32) for n in (150, 40))
    options = {"sh_degree": sh_degree, "crop": crop, "antialiased": antialiased, "frozen": frozen}
    draws = (partial(drawn, draw, view=VIEW, **options) for draw in pair(primitive))
    assert_drawn_alike(*draws, scene, *TOLERANCES[primitive])


@needs_compiler
@BOTH
def test_windows_cuts_and_median_depths_are_those_of_torch(primitive):
    fast, slow = pair(primitive)
    crop = Crop(9, 7, 60, 41)
    window = random_window(fast.window_grid(crop), dtype=torch.float32)
    everywhere = ZWindow.everything(window.grid, "cpu", torch.float32)
    shot = CutShot(VIEW, crop, *everywhere.cut_by(window))
    one, other = (next(draw.cuts(SCENE, [shot], sh_degree=2)) for draw in (fast, slow))
    picture, _ = TOLERANCES[primitive]
    for found, expected in ((one.front, other.front), (one.back, other.back)):
        assert_same_layer(found, expected, atol=picture * float(expected.color.abs().max()))
    # Lists of torch hold what fast ones leave out for leaving no fragment.
    assert set(one.kept_ids.tolist()) <= set(other.kept_ids.tolist())
    assert torch.equal(one.inside.planes, fast.project(SCENE, VIEW, sh_degree=2)[one.kept_ids].planes)
    masked = [drawn(draw, SCENE, VIEW, crop=crop, z_window=window, sh_degree=0) for draw in (fast, slow)]
    assert relative_error(*map(stacked, masked)) < picture
    one, other = (next(draw.depth_windows(SCENE, [Shot(VIEW, crop)], visible=0.05)) for draw in (fast, slow))
    for difference in (one.near - other.near, one.far - other.far):
        assert float((difference.abs() > 1e-4).float().mean()) < 0.02  # a weight may fall to either side
    nothing = torch.ones(61, 83), torch.zeros(61, 83)
    found, expected = (draw.deepened(SCENE, VIEW, None, nothing) for draw in (fast, slow))
    assert float(((found[1] - expected[1]).abs() > 1e-3).float().mean()) < 0.01
    assert relative_error(found[0], expected[0]) < 1e-4


@needs_compiler
@BOTH
def test_no_result_depends_on_the_number_of_threads(threads, primitive):
    draw, found = TorchRasterizer(primitive=primitive), []
    for count in (1, 2, 5):
        threads(count)
        image, grads = gradients(lambda g: draw(g, VIEW, sh_degree=3), SCENE)
        found.append([image, *grads.values()])
    for other in found[1:]:
        assert all(map(torch.equal, found[0], other))


@needs_compiler
@pytest.mark.parametrize("size", [(SSIM_WINDOW, SSIM_WINDOW), (SSIM_WINDOW + 1, 40), (33, 61)])
def test_the_loss_is_that_of_torch(size):
    photo, found = torch.rand(*size, 3), []
    for dtype in (torch.float32, torch.float64):  # float64 is torch's
        rendered = torch.linspace(0, 1, photo.numel(), dtype=dtype).view_as(photo).requires_grad_()
        loss = photometric_loss(rendered, photo.to(dtype), full_pixels=5000, full_windows=4000)
        loss.backward()
        found.append((loss.detach().double(), rendered.grad.double()))
    torch.testing.assert_close(found[0], found[1], rtol=1e-4, atol=1e-8)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_half_the_rows_of_windows_tell_the_loss_of_all(dtype):
    noise = F.interpolate(torch.randn(1, 3, 12, 16, dtype=dtype), size=(72, 96), mode="bicubic")[0]
    photo = torch.rand(72, 96, 3, dtype=dtype)
    gradients = []
    for ours in (True, False):
        rendered = (0.8 * photo + 0.1 + 0.05 * noise.permute(1, 2, 0)).requires_grad_()
        if ours:
            loss = photometric_loss(rendered, photo, full_pixels=72 * 96, full_windows=62 * 86)
        else:
            one, other = (picture.permute(2, 0, 1)[None] for picture in (rendered, photo))
            loss = 0.8 * (rendered - photo).abs().mean() + 0.2 * (1 - ssim(one, other, data_range=1))
        loss.backward()
        gradients.append(rendered.grad[10:-10])  # at the border some pixels are in no window
    assert relative_error(*gradients) < 0.01


@needs_compiler
def test_a_forked_child_draws_as_its_parent_does(threads):
    threads(3)
    before = stacked(TorchRasterizer()(SCENE, VIEW, sh_degree=0))
    child = os.fork()
    if child == 0:
        signal.alarm(60)  # it would wait for threads that are not there
        same = torch.equal(before, stacked(TorchRasterizer()(SCENE, VIEW, sh_degree=0)))
        os._exit(0 if same else 1)
    assert torch.equal(before, stacked(TorchRasterizer()(SCENE, VIEW, sh_degree=0)))
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


def failing(monkeypatch, returncode: int = 1, stderr: str = "native.cpp:1:1: error: no such instruction\n"):
    def run(command, check, **_):
        if check:
            raise subprocess.CalledProcessError(returncode, command, "", stderr)
        return subprocess.CompletedProcess(command, returncode, "", stderr)

    monkeypatch.setattr(native.subprocess, "run", run)
    monkeypatch.setattr(native, "find_compiler", lambda: "g++")


def damaged(folder: Path) -> None:
    folder.mkdir()
    native.library_path().write_bytes(b"not a library")


FAULTS = {
    "compiler fails": (lambda patch, _: failing(patch), "no such instruction"),
    "compiler is killed": (lambda patch, _: failing(patch, -9, ""), "died with"),
    "no compiler": (lambda patch, _: patch.setattr(native, "find_compiler", lambda: None), "apt-get install"),
    "folder is a file": (lambda _, folder: folder.write_text(""), "kernels"),
    "damaged library": (lambda _, folder: damaged(folder), "native-"),
}


@pytest.mark.parametrize(("happen", "says"), FAULTS.values(), ids=FAULTS)
def test_without_the_library_one_line_says_why_and_torch_draws(own_library, monkeypatch, happen, says):
    happen(monkeypatch, own_library)
    rasterizer = TorchRasterizer()
    with pytest.warns(UserWarning, match=f"runs in torch, 20 times slower: .*{says}") as told:
        rasterizer.warm_up()
    image = rasterizer(SCENE, VIEW, sh_degree=0)  # without another warning: tests take them for errors
    assert len(told) == 1
    assert "\n" not in str(told[0].message)
    assert torch.equal(image.color, TorchRasterizer(use_native=False)(SCENE, VIEW, sh_degree=0).color)


@needs_compiler
def test_a_processor_without_wide_vectors_is_served(own_library, monkeypatch):
    """Code for the oldest processor of this machine's kind: four lanes."""
    expected = stacked(TorchRasterizer(use_native=False)(SCENE, VIEW, sh_degree=1))
    monkeypatch.setattr(native, "TUNED", ((),))
    plain = tuple("-O0" if flag == "-O3" else flag for flag in native.FLAGS)  # which compiles soonest
    monkeypatch.setattr(native, "FLAGS", plain)
    found = stacked(TorchRasterizer()(SCENE, VIEW, sh_degree=1))
    assert list(own_library.glob("native-*.so"))
    assert relative_error(found, expected) < 1e-5


@needs_compiler
def test_adam_is_that_of_torch():
    values = torch.randn(500, 3, generator=torch.Generator().manual_seed(0))
    ours, theirs = (values.clone().requires_grad_() for _ in range(2))
    options = {"lr": 0.01, "betas": (0.9, 0.99), "eps": 1e-15}
    pairs = ((ours, Adam([ours], fused=True, **options)), (theirs, torch.optim.Adam([theirs], **options)))
    for step in range(5):
        for value, optimizer in pairs:
            value.grad = torch.sin(value.detach() * (step + 1))
            optimizer.step()
    assert relative_error(ours.detach(), theirs.detach()) < 1e-5
    for name in ("exp_avg", "exp_avg_sq", "step"):
        assert relative_error(pairs[0][1].state[ours][name], pairs[1][1].state[theirs][name]) < 1e-5
