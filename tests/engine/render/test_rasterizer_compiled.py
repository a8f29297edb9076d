"""Built kernels agree with the eager ones, and failing to build is survived."""

import subprocess
import sys

import pytest
import torch

from abcd_ns.engine.build_kernels import all_kernels
from abcd_ns.engine.kernels import Kernel, build, find_compiler
from abcd_ns.engine.kernels.kernel import FOLDER_VARIABLE, forget_loaded
from abcd_ns.engine.kernels.photometric import PHOTOMETRIC_KERNELS, SSIM_WINDOW
from abcd_ns.engine.render import TorchRasterizer
from abcd_ns.engine.render.cpu import chunk_kernels as chunk_kernels_module
from abcd_ns.engine.render.cpu.chunk_kernels import ChunkKernels, chunk_kernels
from abcd_ns.engine.render.loss import photometric_loss
from abcd_ns.engine.types import Crop
from tests.reference.rasterizer_scenes import gradients, random_gaussians, relative_error, small_view

needs_compiler = pytest.mark.skipif(
    find_compiler() is None, reason="building kernels needs a C++ compiler, and none is on the PATH"
)


@pytest.fixture
def own_folder(tmp_path, monkeypatch):
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path))
    forget_loaded()
    yield tmp_path
    forget_loaded()


def scaled_sums(values: torch.Tensor, factor: torch.Tensor) -> tuple[torch.Tensor]:
    """A kernel that builds in seconds; its gradient goes through torch.func."""
    return torch.func.vjp(lambda x: (x * x).sum(dim=0) * factor[0], values)[1](values[0] + factor[1])


@needs_compiler
def test_a_kernel_is_built_found_again_and_agrees(own_folder):
    kernel = Kernel("squares", scaled_sums, ("3 n", "2"))
    values, factor = torch.rand(3, 50), torch.rand(2)
    assert not kernel.is_built
    expected = kernel(values, factor)[0]
    build.compile_kernel(kernel)
    forget_loaded()
    assert kernel.is_built
    for width in (50, 2, 17):
        found, again = kernel(values[:, :width].contiguous(), factor), scaled_sums(values[:, :width], factor)
        torch.testing.assert_close(found[0], again[0])
    assert torch.equal(kernel(values, factor, built=False)[0], expected)
    assert [path.name.startswith("squares-") for path in own_folder.glob("*.pt2")] == [True]


@pytest.mark.parametrize(
    "values", [torch.rand(3, 1), torch.rand(3, 8, dtype=torch.float64), torch.rand(8, 3).T, torch.rand(3, 0)]
)
def test_what_machine_code_does_not_serve_runs_eagerly(values):
    kernel = Kernel("squares", scaled_sums, ("3 n", "2"))
    factor = torch.rand(2).to(values)
    assert not kernel.suits(values, factor)
    assert torch.equal(kernel(values, factor)[0], scaled_sums(values, factor)[0])


needs_kernels = pytest.mark.skipif(
    not TorchRasterizer("auto").kernels.built, reason="the kernels are not built here: make setup"
)


@needs_kernels
@pytest.mark.parametrize("antialiased", [False, True])
def test_built_equals_eager(antialiased):
    view, gaussians = small_view(dtype=torch.float32), random_gaussians(60, dtype=torch.float32)
    eager, built = TorchRasterizer("never"), TorchRasterizer("auto")
    for crop in (None, Crop(4, 4, 4, 4), Crop(3, 2, 17, 9)):  # the second is a single tile
        options = {"sh_degree": 1, "crop": crop, "antialiased": antialiased}
        image, grads = gradients(lambda g, o=options: eager(g, view, **o), gaussians)
        image2, grads2 = gradients(lambda g, o=options: built(g, view, **o), gaussians)
        assert float((image2 - image).abs().max()) < 1e-5
        for name, grad in grads.items():
            assert relative_error(grads2[name], grad) < 1e-4, name


@needs_kernels
def test_built_weights_equal_eager():
    view, gaussians = small_view(dtype=torch.float32), random_gaussians(60, dtype=torch.float32)
    eager, built = (
        TorchRasterizer(policy).depth_window(gaussians, view, crop=view.full, visible=0.05)
        for policy in ("never", "auto")
    )
    for plane in ("near", "far"):
        differs = (getattr(eager, plane) - getattr(built, plane)).abs() > 1e-4
        assert float(differs.float().mean()) < 0.02  # a weight may fall to either side of what is visible


@needs_kernels
@pytest.mark.parametrize("size", [(SSIM_WINDOW, SSIM_WINDOW), (SSIM_WINDOW + 1, 40), (33, 61)])
def test_built_loss_equals_eager(size):
    photo = torch.rand(*size, 3)
    found = []
    for dtype in (torch.float32, torch.float64):  # float64 is eager
        rendered = torch.linspace(0, 1, photo.numel(), dtype=dtype).view_as(photo).requires_grad_()
        loss = photometric_loss(rendered, photo.to(dtype), full_pixels=5000, full_windows=4000)
        loss.backward()
        found.append((loss.detach().double(), rendered.grad.double()))
    torch.testing.assert_close(found[0], found[1], rtol=1e-4, atol=1e-8)


@pytest.mark.usefixtures("own_folder")
def test_failing_to_build_warns_and_stays_eager(monkeypatch):
    def fail(*_args, **_options):
        return subprocess.CompletedProcess([], 1, "", "Traceback\nRuntimeError: no such compiler")

    monkeypatch.setattr(build.subprocess, "run", fail)
    monkeypatch.setattr(build, "find_compiler", lambda: "g++")
    view, gaussians = small_view(dtype=torch.float32), random_gaussians(10, dtype=torch.float32)
    rasterizer = TorchRasterizer()
    with pytest.warns(UserWarning, match="stays slow: RuntimeError: no such compiler"):
        rasterizer.warm_up()
    expected = TorchRasterizer("never")(gaussians, view, sh_degree=0)
    assert torch.equal(rasterizer(gaussians, view, sh_degree=0).color, expected.color)


def test_a_damaged_file_warns_and_stays_eager(own_folder):
    kernel = chunk_kernels(4, 16)[0]
    kernel.path.write_bytes(b"not a package")
    assert kernel.path.parent == own_folder
    with pytest.warns(UserWarning, match="cannot be loaded"):
        assert not kernel.is_built


@pytest.mark.parametrize("policy", ["auto", "never"])
def test_without_built_kernels_nothing_is_built_unasked(own_folder, policy):
    assert not ChunkKernels(policy, 4, 16).built
    assert not list(own_folder.iterdir())


def test_never_means_never(monkeypatch):
    monkeypatch.setattr(build, "find_compiler", lambda: pytest.fail("asked for a compiler"))
    kernels = ChunkKernels("never", 4, 16)
    kernels.warm_up()
    assert not kernels.built


def test_float64_is_eager_whatever_is_built():
    view, gaussians = small_view(dtype=torch.float64), random_gaussians(20, dtype=torch.float64)
    auto, never = (TorchRasterizer(policy)(gaussians, view, sh_degree=0) for policy in ("auto", "never"))
    assert torch.equal(auto.color, never.color)


def test_names_tell_all_kernels_and_sizes_apart():
    kernels = {kernel for side in (2, 4) for chunk in (8, 16) for kernel in all_kernels(side, chunk)}
    assert len({kernel.path for kernel in kernels}) == len(kernels) == 7 + 4 * 3


def test_using_kernels_does_not_import_the_compiler():
    code = (
        "import sys, torch; before = set(sys.modules); "
        "from abcd_ns.engine.render import TorchRasterizer; TorchRasterizer('auto').kernels.built; "
        "sys.exit(any(name.startswith('torch._inductor.codegen') for name in set(sys.modules) - before))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_kernels_of_the_loss_that_are_missing_are_built_too(monkeypatch):
    """Those that draw may be there: of an earlier version, whose loss was another."""
    asked = []
    monkeypatch.setattr(Kernel, "is_built", property(lambda kernel: kernel not in PHOTOMETRIC_KERNELS))
    monkeypatch.setattr(chunk_kernels_module, "build_kernels", lambda kernels, *_: asked.extend(kernels))
    kernels = ChunkKernels("auto", 4, 8)
    assert kernels.built
    kernels.warm_up()
    assert set(PHOTOMETRIC_KERNELS) <= set(asked)
