"""The compiled kernels agree with the eager ones, and failing to compile is survived."""

import os
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
import torch

from abcd_ns.engine.rasterizer import TorchRasterizer, chunk_kernels
from abcd_ns.engine.rasterizer.chunk_kernels import ChunkKernels, has_cpp_compiler
from tests.engine.rasterizer_scenes import gradients, random_gaussians, relative_error, small_view

ROOT = Path(__file__).parents[2]

# In a process of its own: there the modules are not wrapped by the type checker, which dynamo cannot trace.
COMPARE = """
import torch
from abcd_ns.engine.rasterizer import TorchRasterizer
from abcd_ns.engine.types import Crop
from tests.engine.rasterizer_scenes import gradients, random_gaussians, relative_error, small_view

torch.set_num_threads(2)
view, gaussians = small_view(dtype=torch.float32), random_gaussians(60, dtype=torch.float32)
eager, compiled = (TorchRasterizer(policy, chunk=2) for policy in ("never", "always"))
for crop in (None, Crop(4, 4, 4, 4), Crop(3, 2, 17, 9)):  # the second is a single tile
    image, grads = gradients(lambda g: eager(g, view, sh_degree=1, crop=crop), gaussians)
    image2, grads2 = gradients(lambda g: compiled(g, view, sh_degree=1, crop=crop), gaussians)
    assert (image2 - image).abs().max() < 1e-5
    for name, grad in grads.items():
        assert relative_error(grads2[name], grad) < 1e-4, name
assert compiled.kernels.policy == "always", "fell back to eager"
print("graphs", torch._dynamo.utils.counters["stats"]["unique_graphs"])
"""


@pytest.mark.skipif(
    not has_cpp_compiler(), reason="torch.compile needs a C++ compiler, and none is on the PATH"
)
def test_compiled_equals_eager():
    environment = {**os.environ, "TORCHINDUCTOR_COMPILE_THREADS": "1"}  # starting workers would cost more
    command = [sys.executable, "-c", COMPARE]
    run = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300)
    assert run.returncode == 0, run.stderr[-3000:]
    assert "graphs 2" in run.stdout, "one graph per kernel, whatever the sizes"


def broken_compile(_kernel):
    def fail(*_args):
        raise RuntimeError("no such compiler")

    return fail


def test_failing_to_compile_warns_once_and_stays_eager(monkeypatch):
    monkeypatch.setattr(chunk_kernels, "_compiled", broken_compile)
    view, gaussians = small_view(dtype=torch.float32), random_gaussians(10, dtype=torch.float32)
    rasterizer = TorchRasterizer("always")
    with pytest.warns(UserWarning, match=r"torch\.compile failed.*no such compiler"):
        image, grads = gradients(lambda g: rasterizer(g, view, sh_degree=0), gaussians)
    expected, expected_grads = gradients(lambda g: TorchRasterizer("never")(g, view, sh_degree=0), gaussians)
    assert torch.equal(image, expected)
    assert relative_error(grads["means"], expected_grads["means"]) == 0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        rasterizer(gaussians, view, sh_degree=0)


@pytest.mark.parametrize(
    ("policy", "dtype", "seconds", "expected"),
    [
        ("never", torch.float32, 1e9, False),
        ("always", torch.float64, 0.0, True),
        ("auto", torch.float32, 0.0, False),
        ("auto", torch.float32, 1e9, True),
        ("auto", torch.float64, 1e9, False),
    ],
)
def test_policy(monkeypatch, policy, dtype, seconds, expected):
    monkeypatch.setattr(chunk_kernels, "has_cpp_compiler", lambda: True)
    kernels = ChunkKernels(policy)
    kernels.eager_seconds = seconds
    assert kernels.compiles(torch.zeros(1, dtype=dtype)) is expected


def test_auto_stays_eager_without_a_compiler(monkeypatch):
    monkeypatch.setattr(chunk_kernels, "has_cpp_compiler", lambda: False)
    kernels = ChunkKernels("auto")
    kernels.eager_seconds = 1e9
    assert not kernels.compiles(torch.zeros(1))
