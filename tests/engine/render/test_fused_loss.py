"""CUDA's kernels of the loss where they turn out not to compile: on a GPU, which is not here."""

import re
import subprocess
import warnings

import pytest
import torch

from abcd_ns.engine.render.cuda.fused import Fused


class Elsewhere(torch.Tensor):
    """Says that it is on CUDA."""

    is_cuda = True

    def get_device(self):
        return -1  # for a guard: no device that there is


ON_CUDA, DOUBLE = (
    torch.zeros(4, dtype=kind).as_subclass(Elsewhere) for kind in (torch.float32, torch.float64)
)


def failing(error):
    def fail(*_):
        raise error

    return Fused("The loss", fail)


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


@pytest.mark.parametrize(
    "error",
    [torch.cuda.OutOfMemoryError(), RuntimeError("CUDA error: an illegal memory access was encountered")],
)
def test_a_fault_of_the_device_is_not_taken_for_that(error):
    with pytest.raises(type(error)):
        failing(error)(ON_CUDA, ON_CUDA, 0.5, 0.5)


def test_what_has_run_compiles():
    answers = iter([None, ZeroDivisionError("a fault of our own")])

    def run(*_):
        answer = next(answers)
        if answer is not None:
            raise answer
        return "found"

    fused = Fused("The loss", run)
    assert not fused.runs
    assert fused(ON_CUDA, ON_CUDA) == "found"
    assert fused.runs
    with pytest.raises(ZeroDivisionError):
        fused(ON_CUDA, ON_CUDA)


def test_they_run_on_the_device_that_has_the_tensors(monkeypatch):
    seen = []

    class Guard:
        def __init__(self, of):
            seen.append(of)

        def __enter__(self): ...

        def __exit__(self, *_): ...

    monkeypatch.setattr(torch.cuda, "device_of", Guard)
    Fused("The loss", lambda *_: 0)(ON_CUDA)
    assert seen == [ON_CUDA]


def test_they_are_for_single_floats_on_cuda():
    fused = Fused("The loss", lambda rendered, photo, *_: (rendered, photo))
    assert fused(ON_CUDA, ON_CUDA, 0.5, 0.25) is not None
    assert fused(torch.zeros(4), torch.zeros(4), 0.5, 0.5) is None
    assert fused(DOUBLE, DOUBLE, 0.5, 0.5) is None
