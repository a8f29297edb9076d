"""The package's own CUDA kernels against their twins, and where they do not compile."""

import os
import re
import subprocess
import sys

import pytest
import torch

from abcd_ns.engine.render.cuda.fused import Fused

LOSS = """
import torch
from abcd_ns.engine.kernels.photometric import photometric_sums
from abcd_ns.engine.render.cuda.photometric import photometric

generator = torch.Generator().manual_seed(0)
for height, width in ((11, 11), (11, 40), (29, 12), (33, 61)):
    rendered, photo = torch.rand(2, height, width, 3, generator=generator)
    photo[:5] = rendered[:5]
    loss, gradient = photometric(rendered, photo, 0.3, 0.7)
    sums, expected = photometric_sums(rendered.double(), photo.double(), (0.3, 0.7))
    torch.testing.assert_close(loss.double(), 0.3 * sums[0] + 0.7 * sums[1], rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(gradient.double(), expected, rtol=1e-4, atol=1e-5)
"""
BETWEEN = """
import torch
from abcd_ns.engine.render.cuda.between import between
from abcd_ns.engine.render.base import Surroundings
from abcd_ns.engine.types import Layer
from tests.reference import triton_stand_ins as twins

generator = torch.Generator().manual_seed(0)
def values(*shape):
    return torch.rand(*shape, generator=generator)

def layer(height, width):  # as a visit keeps them: channels of one tensor, a part of a larger one
    pixels = values(height + 3, width + 5, 4).half()[2 : height + 2, 1 : width + 1]
    return Layer(pixels[..., :3], pixels[..., 3])

features, alphas = 2 * values(3, 32, 48, 4) - 0.5, values(3, 32, 48, 1)
features[0, 5, 9, 1] = torch.nan
parts = (slice(3, 28), slice(0, 41)), (slice(0, 32), slice(15, 48)), (slice(0, 1), slice(0, 1))
for layers, counts in ((False, 0.0), (True, 1.0), (True, 2.5)):
    shown = []
    for rows, columns in parts:
        size = rows.stop - rows.start, columns.stop - columns.start
        pair = (layer(*size), layer(*size)) if layers else (None, None)
        shown.append(((rows, columns), Surroundings(*pair, values(3), counts)))
    found, expected = between(features, alphas, shown), twins.between(features, alphas, shown)
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6, equal_nan=True)
    upstream = [values(*picture.shape) - 0.5 for picture in found]
    found, expected = (each(features, alphas, shown, upstream) for each in (between, twins.between))
    assert bool(expected[0][..., 3].any()) == (counts > 0)
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6, equal_nan=True)
"""
GAUSSIANS = """
import torch
from abcd_ns.engine.render.cuda.by_row import shade, skips
from tests.reference import triton_stand_ins as twins

generator = torch.Generator().manual_seed(0)
for cameras, n in ((1, 1), (3, 257)):
    colors = torch.randn(cameras, n, 3, generator=generator)
    depths = torch.rand(cameras, n, generator=generator)
    colors[0, 0, 0] = -0.5
    for given in (depths, None):
        for found, expected in zip(shade(colors, given), twins.shade(colors, given), strict=True):
            assert torch.equal(found, expected)
for wrong in (None, torch.nan, torch.inf):
    norms = list(torch.rand(5, generator=generator))
    if wrong is not None:
        norms[2] = torch.tensor(wrong)
    count = torch.tensor(7.5)
    assert float(skips(count, norms)) == (wrong is not None)
    assert float(count) == 7.5 + (wrong is None)
"""
WINDOWS = """
import torch
from abcd_ns.engine.render.cuda.by_row import windowed
from tests.reference import triton_stand_ins as twins

generator = torch.Generator().manual_seed(0)
cameras, tiles, bits = 3, 11, 4
for count, always in ((0, 0), (1, 0), (700, 0), (700, 150)):
    camera = torch.randint(cameras, (count,), generator=generator)
    tile = torch.randint(tiles, (count,), generator=generator)
    z = (torch.rand(count, generator=generator) + 0.5).view(torch.int32).long()
    keys = ((camera << bits | tile) << 32 | z).sort().values
    owners = torch.randint(300, (count,), generator=generator, dtype=torch.int32)
    near = torch.rand(cameras * tiles, generator=generator)
    sheet = bits, tiles, (2 << bits | 10) << 32 | 0x7FFFFFFF
    given = near, near + 0.6, keys, owners, always, *sheet
    found, expected = windowed(*given), twins.windowed(*given)
    assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))
"""


def test_they_are_their_twins():
    """In one process, since the interpreter is chosen when kernels are imported."""
    pytest.importorskip("triton")
    command = [sys.executable, "-c", LOSS + BETWEEN + GAUSSIANS + WINDOWS]
    environment = {**os.environ, "TRITON_INTERPRET": "1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


class Elsewhere(torch.Tensor):
    """Says that it is on CUDA."""

    is_cuda = True

    def get_device(self):
        return -1  # for a guard: no device that there is


ON_CUDA = torch.zeros(4).as_subclass(Elsewhere)
DOUBLE = torch.zeros(4, dtype=torch.float64).as_subclass(Elsewhere)


def failing(error):
    def fail(*_):
        raise error

    return Fused("The loss", fail)


@pytest.mark.parametrize("error", [RuntimeError("no compiler"), subprocess.CalledProcessError(1, "gcc")])
def test_where_they_do_not_compile_it_is_said_once(error):
    fused = failing(error)
    with pytest.warns(UserWarning, match=f"The loss runs uncompiled.*{re.escape(str(error))}"):
        assert fused(ON_CUDA, ON_CUDA, 0.5, 0.5) is None
    assert fused(ON_CUDA, ON_CUDA, 0.5, 0.5) is None  # without another warning: tests take them for errors


@pytest.mark.parametrize(
    "error",
    [torch.cuda.OutOfMemoryError(), RuntimeError("CUDA error: an illegal memory access was encountered")],
)
def test_a_fault_of_the_device_is_not_taken_for_that(error):
    with pytest.raises(type(error)):
        failing(error)(ON_CUDA, ON_CUDA, 0.5, 0.5)


def test_what_has_run_compiles():
    answers = iter([lambda: "found", lambda: 1 / 0])
    fused = Fused("The loss", lambda *_: next(answers)())
    assert not fused.runs
    assert fused(torch.zeros(4)) is None  # they are for single floats on CUDA
    assert fused(DOUBLE) is None
    assert fused(ON_CUDA) == "found"
    assert fused.runs
    with pytest.raises(ZeroDivisionError):
        fused(ON_CUDA)
