"""A process that works for another and dies is an error or a warning, never a wait without end."""

import os
import signal
import sys
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import pytest
import torch

from abcd_ns.engine.kernels import build
from abcd_ns.engine.kernels.kernel import FOLDER_VARIABLE, Kernel, kernels_folder


class Deadly(Kernel):
    """A kernel whose compiler is killed, as one is that needs more memory than there is."""

    is_built = False

    @property
    def path(self) -> Path:
        os.kill(os.getpid(), signal.SIGKILL)
        raise AssertionError("it lives")


def alone(values: torch.Tensor) -> tuple[torch.Tensor]:
    return (values,)


DEADLY = Deadly("deadly", alone, ("n",))


@pytest.fixture(autouse=True)
def _own_folder(tmp_path, monkeypatch):
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path))


def test_a_killed_compiler_is_an_error():
    with pytest.raises(BrokenProcessPool):
        build.compile_all([DEADLY])


def test_a_killed_builder_is_a_warning_and_kernels_stay_eager(monkeypatch):
    run = build.subprocess.run
    suicide = [sys.executable, "-c", "import os; os.kill(os.getpid(), 9)"]
    monkeypatch.setattr(build.subprocess, "run", lambda _, **options: run(suicide, **options))
    monkeypatch.setattr(build, "find_compiler", lambda: "g++")
    with pytest.warns(UserWarning, match="stays slow: exit code -9"):
        build.build_kernels([DEADLY], 4, 16)
    values = torch.arange(3.0)
    assert torch.equal(*DEADLY(values), values)
    assert not any(kernels_folder().iterdir())
