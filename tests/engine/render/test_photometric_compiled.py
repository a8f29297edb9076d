"""The loss where it is compiled when first called: on CUDA, which is not here."""

import warnings

import pytest
import torch

from abcd_ns.engine.kernels.photometric import Compiled


def double(x):
    return 2 * x


def test_it_is_compiled_once_for_all_sizes(monkeypatch):
    asked = []

    def compile(function, **options):
        asked.append(options)
        return lambda x: function(x) + 0

    monkeypatch.setattr(torch, "compile", compile)
    run = Compiled(double)
    assert [float(run(torch.ones(size)).sum()) for size in (1, 2, 5)] == [2, 4, 10]
    assert asked == [{"dynamic": True}]


@pytest.mark.parametrize("error", [RuntimeError("no compiler"), ImportError("triton"), OSError("no room")])
def test_where_that_fails_it_runs_as_it_is_and_says_so_once(monkeypatch, error):
    def compile(function, **_):  # noqa: ARG001 - torch's signature
        def fail(_):
            raise error

        return fail

    monkeypatch.setattr(torch, "compile", compile)
    run = Compiled(double)
    with pytest.warns(UserWarning, match=f"The loss runs uncompiled.*{error}"):
        assert float(run(torch.ones(()))) == 2
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert float(run(torch.ones(()))) == 2


def test_a_full_memory_is_not_taken_for_a_failure_to_compile(monkeypatch):
    def compile(function, **_):  # noqa: ARG001
        def fail(_):
            raise torch.OutOfMemoryError

        return fail

    monkeypatch.setattr(torch, "compile", compile)
    with pytest.raises(torch.OutOfMemoryError):
        Compiled(double)(torch.ones(()))
