"""CUDA's kernels of the loss where they turn out not to compile: on a GPU, which is not here."""

import re
import subprocess
import warnings

import pytest
import torch

from abcd_ns.engine.render.loss import Fused


class Elsewhere(torch.Tensor):
    """Says that it is on CUDA."""

    is_cuda = True


ON_CUDA, DOUBLE = (
    torch.zeros(4, dtype=kind).as_subclass(Elsewhere) for kind in (torch.float32, torch.float64)
)


def failing(error):
    def fail(*_):
        raise error

    return Fused(fail)


@pytest.mark.parametrize(
    "error",
    [
        RuntimeError("no compiler"),
        ImportError("triton"),
        OSError("no room"),
        subprocess.CalledProcessError(1, "gcc"),  # it finds no Python.h
        AssertionError("libcuda.so cannot found"),
        type("PTXASError", (Exception,), {})("no such GPU"),
    ],
)
def test_where_they_do_not_it_is_said_once(error):
    fused = failing(error)
    with pytest.warns(UserWarning, match=f"The loss runs uncompiled.*{re.escape(str(error))}"):
        assert fused(ON_CUDA, ON_CUDA, 0.5, 0.5) is None
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert fused(ON_CUDA, ON_CUDA, 0.5, 0.5) is None


def test_a_full_memory_is_not_taken_for_that():
    with pytest.raises(torch.cuda.OutOfMemoryError):
        failing(torch.cuda.OutOfMemoryError())(ON_CUDA, ON_CUDA, 0.5, 0.5)


def test_they_are_for_single_floats_on_cuda():
    fused = Fused(lambda rendered, photo, *_: (rendered, photo))
    assert fused(ON_CUDA, ON_CUDA, 0.5, 0.25) is not None
    assert fused(torch.zeros(4), torch.zeros(4), 0.5, 0.5) is None
    assert fused(DOUBLE, DOUBLE, 0.5, 0.5) is None
