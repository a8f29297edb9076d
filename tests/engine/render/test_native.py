"""The native library agrees with torch on any number of threads; without it, torch draws."""

import subprocess
import sys

import pytest
import torch

from abcd_ns.engine.gaussians.adam import Adam
from abcd_ns.engine.kernels import find_compiler, library, native
from abcd_ns.engine.kernels.photometric import SSIM_WINDOW
from abcd_ns.engine.render import CutShot, Shot, TorchRasterizer, ZWindow
from abcd_ns.engine.render.loss import photometric_loss
from abcd_ns.engine.render.primitive import PRIMITIVES
from abcd_ns.engine.types import Crop
from abcd_ns.machine import threads_wanted
from tests.reference.rasterizer_scenes import (
    as_leaves,
    gradients,
    probe,
    random_gaussians,
    small_view,
    stacked,
)

VIEW = small_view(83, 61, dtype=torch.float32)
SCENE = random_gaussians(300, dtype=torch.float32)
CROPS = (None, Crop(4, 4, 4, 4), Crop(3, 2, 17, 9), Crop(21, 13, 62, 48))
needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C++ compiler is on the PATH")
BOTH = pytest.mark.parametrize("primitive", PRIMITIVES)
TOLERANCES = {"3dgs": (1e-5, 1e-4), "2dgs": (3e-5, 5e-4)}
"""Of pictures and of gradients in float32; a surfel divides by what may be next to nothing."""


def off(found: torch.Tensor, expected: torch.Tensor) -> float:
    """The largest difference, as a share of the largest value."""
    return float((found - expected).abs().max() / expected.abs().max().clamp_min(1e-30))


def pair(primitive: str) -> tuple[TorchRasterizer, TorchRasterizer]:
    return tuple(TorchRasterizer(use_native=each, primitive=primitive) for each in (True, False))


@pytest.fixture
def own_library(tmp_path, monkeypatch):
    """A folder without a library, and nothing loaded."""
    monkeypatch.setenv(native.FOLDER_VARIABLE, str(tmp_path / "kernels"))
    library.cache_clear()
    yield tmp_path / "kernels"
    library.cache_clear()


@needs_compiler
@BOTH
@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("sh_degree", [0, 1, 3])
def test_pictures_and_gradients_are_those_of_torch(primitive, antialiased, sh_degree):
    picture, gradient = TOLERANCES[primitive]
    fast, slow = pair(primitive)
    frozen = random_gaussians(40, seed=7, dtype=torch.float32)
    for crop in CROPS:
        options = {"sh_degree": sh_degree, "crop": crop, "antialiased": antialiased, "frozen": frozen}
        expected, expected_grads = gradients(lambda g, o=options: slow(g, VIEW, **o), SCENE)
        image, grads = gradients(lambda g, o=options: fast(g, VIEW, **o), SCENE)
        assert off(image, expected) < picture
        for name, grad in expected_grads.items():
            assert off(grads[name], grad) < gradient, name


@needs_compiler
@pytest.mark.parametrize("sh_degree", [1, 2])
def test_fewer_harmonics_are_taken_as_they_are(sh_degree):
    fast, slow = pair("3dgs")
    scene = random_gaussians(50, sh_degree=sh_degree, dtype=torch.float32)
    found, expected = (
        gradients(lambda g, d=d: d(g, VIEW, sh_degree=sh_degree), scene)[1] for d in (fast, slow)
    )
    for name, grad in expected.items():
        assert off(found[name], grad) < 1e-4, name


@needs_compiler
@BOTH
def test_several_views_what_each_counts_and_weighs(primitive):
    shots = [Shot(VIEW, VIEW.full), Shot(VIEW, Crop(9, 8, 30, 20)), Shot(VIEW, Crop(40, 0, 43, 61))]
    for options in ({"judge": True}, {"judge": True, "weigh": True}):
        found = []
        for draw in pair(primitive):
            leaves = as_leaves(SCENE)
            rasters = draw.draw(leaves, shots, sh_degree=1, **options)
            info = rasters[0].info
            info["sums"].ask([probe(*r.depth.shape, dtype=torch.float32)[..., :4] for r in rasters])
            sum((stacked(r) * probe(*r.depth.shape, dtype=torch.float32)).sum() for r in rasters).backward()
            more = [info["weights"].grad] if "weigh" in options else []
            more += info["sums"].values.split((1, 3, 3, 3), dim=2)
            found.append([leaves.means.grad, leaves.features_rest.grad, info["means2d"].grad, *more])
        for one, other in zip(*found, strict=True):
            assert one.shape == other.shape
            assert off(one, other) < TOLERANCES[primitive][1]


@needs_compiler
@BOTH
def test_windows_cuts_and_median_depths_are_those_of_torch(primitive):
    fast, slow = pair(primitive)
    crop = Crop(9, 7, 60, 41)
    grid = fast.window_grid(crop)
    ends = 3 + torch.rand(2, grid.tiles, generator=torch.Generator().manual_seed(0))
    window = ZWindow(grid, ends[0], ends[0] + ends[1] - 3)
    everywhere = ZWindow.everything(grid, "cpu", torch.float32)
    shot = CutShot(VIEW, crop, everywhere.before(window), window, everywhere.behind(window))
    one, other = (next(draw.cuts(SCENE, [shot], sh_degree=2)) for draw in (fast, slow))
    for side in ("front", "back"):
        for what in ("color", "transmittance"):
            assert (
                off(*(getattr(getattr(cut, side), what) for cut in (one, other))) < TOLERANCES[primitive][0]
            )
    # Lists of torch hold what fast ones leave out for leaving no fragment.
    assert set(one.members.tolist()) <= set(other.members.tolist())
    assert torch.equal(one.inside.planes, fast.project(SCENE, VIEW, sh_degree=2)[one.members].planes)
    masked = [draw(SCENE, VIEW, crop=crop, z_window=window, sh_degree=0) for draw in (fast, slow)]
    assert off(*map(stacked, masked)) < TOLERANCES[primitive][0]
    near, far = zip(
        *(
            (w.near, w.far)
            for w in (d.depth_window(SCENE, VIEW, crop=crop, visible=0.05) for d in (fast, slow))
        ),
        strict=True,
    )
    for ends in (near, far):
        assert (
            float(((ends[0] - ends[1]).abs() > 1e-4).float().mean()) < 0.02
        )  # a weight may fall to either side
    nothing = torch.ones(61, 83), torch.zeros(61, 83)
    found, expected = (draw.deepened(SCENE, VIEW, None, nothing) for draw in (fast, slow))
    assert float(((found[1] - expected[1]).abs() > 1e-3).float().mean()) < 0.01
    assert off(found[0], expected[0]) < 1e-4


@needs_compiler
@BOTH
def test_no_result_depends_on_the_number_of_threads(primitive):
    draw, found = TorchRasterizer(primitive=primitive), []
    try:
        for threads in (1, 2, 5):
            library().abcd_threads(threads)
            image, grads = gradients(lambda g: draw(g, VIEW, sh_degree=3), SCENE)
            found.append([image, *grads.values()])
    finally:
        library().abcd_threads(threads_wanted())
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


@needs_compiler
def test_a_forked_child_draws_as_its_parent_does():
    code = (
        "import os, torch\n"
        "from abcd_ns.engine.kernels import library\n"
        "from tests.engine.render.test_native import SCENE, VIEW, stacked\n"
        "from abcd_ns.engine.render import TorchRasterizer\n"
        "library().abcd_threads(3)\n"
        "before = stacked(TorchRasterizer()(SCENE, VIEW, sh_degree=0))\n"
        "child = os.fork()\n"
        "same = torch.equal(before, stacked(TorchRasterizer()(SCENE, VIEW, sh_degree=0)))\n"
        "child or os._exit(0 if same else 1)\n"
        "raise SystemExit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) or not same)\n"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=120).returncode == 0


def failing(monkeypatch, returncode: int = 1, stderr: str = "native.cpp:1:1: error: no such instruction\n"):
    def run(command, check, **_):
        if check:
            raise subprocess.CalledProcessError(returncode, command, "", stderr)
        return subprocess.CompletedProcess(command, returncode, "", stderr)

    monkeypatch.setattr(native.subprocess, "run", run)
    monkeypatch.setattr(native, "find_compiler", lambda: "g++")


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        ("compiler fails", "no such instruction"),
        ("compiler is killed", "died with"),
        ("no compiler", "apt-get install g"),
        ("folder is a file", "kernels"),
        ("damaged library", "native-"),
    ],
)
def test_without_the_library_one_line_says_why_and_torch_draws(own_library, monkeypatch, fault, says):
    if fault == "compiler fails":
        failing(monkeypatch)
    elif fault == "compiler is killed":
        failing(monkeypatch, -9, "")
    elif fault == "no compiler":
        monkeypatch.setattr(native, "find_compiler", lambda: None)
    elif fault == "folder is a file":
        own_library.write_text("")
    else:
        own_library.mkdir()
        native.library_path().write_bytes(b"not a library")
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
    found = stacked(TorchRasterizer()(SCENE, VIEW, sh_degree=1))
    assert list(own_library.glob("native-*.so"))
    assert off(found, expected) < 1e-5


def test_float64_is_drawn_by_torch():
    view, scene = small_view(dtype=torch.float64), random_gaussians(20)
    auto, never = (TorchRasterizer(use_native=each)(scene, view, sh_degree=0) for each in (True, False))
    assert torch.equal(auto.color, never.color)


def test_a_tile_side_of_its_own_is_drawn_by_torch(own_library):
    TorchRasterizer(tile_side=8)(SCENE, VIEW, sh_degree=0)
    assert not own_library.exists()


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
    assert off(ours.detach(), theirs.detach()) < 1e-5
    for name in ("exp_avg", "exp_avg_sq", "step"):
        assert off(pairs[0][1].state[ours][name], pairs[1][1].state[theirs][name]) < 1e-5
