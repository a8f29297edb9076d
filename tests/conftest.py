"""Set-up that must happen before any test module is imported."""

import os
import sys
from pathlib import Path
from types import ModuleType

# Threads sleep while they wait: spinning, as is usual, burns a busy machine's time. torch reads it once.
os.environ["OMP_WAIT_POLICY"] = "PASSIVE"

import pytest
import torch
from hypothesis import settings
from jaxtyping import config as checks
from jaxtyping import install_import_hook

# Shapes and dtypes in these packages' signatures are checked when they are called. The hook only works on
# modules that are not imported yet, hence here and not in a fixture.
install_import_hook(["abcd_ns.engine", "abcd_ns.peers"], "beartype.beartype")

# The same sums in the same order on any machine, and room for other processes; those that tests start, too.
torch.set_num_threads(1)
os.environ["OMP_NUM_THREADS"] = "1"

# derandomize: a failure shows up on every run or on none. No deadline: shared machines stall.
settings.register_profile("abcd", derandomize=True, deadline=None, max_examples=25, database=None)
settings.load_profile("abcd")

if not torch.cuda.is_available():
    # The first CUDA op of gsplat would start a build of many CPU-minutes where nvcc is on the PATH, and
    # could not run afterwards. With this it fails at once, as it does where there is no nvcc.
    backend = ModuleType("gsplat.cuda._backend")
    backend._C = None
    sys.modules["gsplat.cuda._backend"] = backend

TRAIN = (
    "engine/train",
    "engine/store",
    "cluster",
    "simulated",
    "peers",
    "lab",
    "nerfstudio",
    "run",
    "cli",
    "benchmarks",
)
"""Folders whose tests train for many steps: checks would take half their time. `test_loss_curves` has every
method train with checks on."""


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers(config):  # noqa: ARG001 - pytest-xdist's signature
    """One more than there are cores: much of test_ray is waiting for processes that begin."""
    return (os.cpu_count() or 1) + 1


@pytest.fixture(autouse=True, scope="module")
def _shapes_are_checked(request):
    folder = request.path.parent.relative_to(Path(__file__).parent).as_posix()
    checks.update("jaxtyping_disable", folder.startswith(TRAIN))
    yield
    checks.update("jaxtyping_disable", False)


@pytest.fixture(autouse=True, scope="module")
def _no_writer_stays():
    """nerfstudio keeps its writers in a list of the process; their folders are gone by the next module."""
    yield
    if (writer := sys.modules.get("nerfstudio.utils.writer")) is not None:
        writer.EVENT_WRITERS.clear()
