"""Built kernels agree with the eager ones, and failing to build is survived."""

import subprocess

import pytest
import torch

from abcd_ns.engine.rasterizer import TorchRasterizer, built_kernels
from abcd_ns.engine.rasterizer.chunk_kernels import ChunkKernels
from abcd_ns.engine.types import Crop
from tests.engine.rasterizer_scenes import gradients, random_gaussians, relative_error, small_view

SMALL = {"tile_side": 2, "chunk": 2}
"""A size that builds in seconds; nobody trains with it."""

needs_compiler = pytest.mark.skipif(
    not built_kernels.can_build(), reason="building kernels needs a C++ compiler, and none is on the PATH"
)


@pytest.fixture
def own_folder(tmp_path, monkeypatch):
    monkeypatch.setenv(built_kernels.FOLDER_VARIABLE, str(tmp_path))
    built_kernels.load_kernels.cache_clear()
    yield tmp_path
    built_kernels.load_kernels.cache_clear()


@needs_compiler
def test_built_equals_eager_and_is_found_again(own_folder):
    view, gaussians = small_view(dtype=torch.float32), random_gaussians(60, dtype=torch.float32)
    eager = TorchRasterizer("never", **SMALL)
    waiting = TorchRasterizer("auto", **SMALL)
    assert not waiting.kernels.are_built
    waiting.warm_up()
    for built in (waiting, TorchRasterizer("auto", **SMALL)):
        assert built.kernels.are_built
        for crop in (None, Crop(4, 4, 2, 2), Crop(3, 2, 17, 9)):  # the second is a single tile
            image, grads = gradients(lambda g, c=crop: eager(g, view, sh_degree=1, crop=c), gaussians)
            image2, grads2 = gradients(lambda g, c=crop, b=built: b(g, view, sh_degree=1, crop=c), gaussians)
            assert float((image2 - image).abs().max()) < 1e-5
            for name, grad in grads.items():
                assert relative_error(grads2[name], grad) < 1e-4, name
    assert len(list(own_folder.glob("*.pt2"))) == 2


@pytest.mark.usefixtures("own_folder")
def test_failing_to_build_warns_and_stays_eager(monkeypatch):
    def fail(*_args, **_options):
        return subprocess.CompletedProcess([], 1, "", "Traceback\nRuntimeError: no such compiler")

    monkeypatch.setattr(built_kernels.subprocess, "run", fail)
    monkeypatch.setattr(built_kernels, "can_build", lambda: True)
    view, gaussians = small_view(dtype=torch.float32), random_gaussians(10, dtype=torch.float32)
    with pytest.warns(UserWarning, match="stays slow: RuntimeError: no such compiler"):
        rasterizer = TorchRasterizer("always")
    expected = TorchRasterizer("never")(gaussians, view, sh_degree=0)
    assert torch.equal(rasterizer(gaussians, view, sh_degree=0).color, expected.color)


@pytest.mark.usefixtures("own_folder")
def test_a_damaged_file_warns_and_stays_eager():
    for path in built_kernels._paths(4, 16):
        path.write_bytes(b"not a package")
    with pytest.warns(UserWarning, match="cannot be loaded"):
        assert not ChunkKernels("auto", 4, 16).are_built


@pytest.mark.parametrize("policy", ["auto", "never"])
def test_without_built_kernels_nothing_is_built_unasked(own_folder, policy):
    assert not ChunkKernels(policy, 4, 16).are_built
    assert not list(own_folder.iterdir())


@pytest.mark.usefixtures("own_folder")
def test_never_means_never(monkeypatch):
    monkeypatch.setattr(built_kernels, "can_build", lambda: pytest.fail("asked for a compiler"))
    kernels = ChunkKernels("never", 4, 16)
    kernels.warm_up()
    assert not kernels.are_built


@needs_compiler
def test_float64_is_eager_whatever_is_built():
    view, gaussians = small_view(dtype=torch.float64), random_gaussians(20, dtype=torch.float64)
    auto, never = (TorchRasterizer(policy)(gaussians, view, sh_degree=0) for policy in ("auto", "never"))
    assert torch.equal(auto.color, never.color)


def test_the_name_of_a_build_depends_on_its_size():
    assert (
        len({path for side in (2, 4) for chunk in (8, 16) for path in built_kernels._paths(side, chunk)}) == 8
    )
