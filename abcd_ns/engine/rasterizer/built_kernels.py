"""The chunk kernels compiled ahead of time for this processor, once, and kept in the user's cache folder.

`torch.export` and AOTInductor turn each kernel into one fused loop in a shared library. Building takes
a minute or two on two cores and needs a C++ compiler; loading takes no time, so every later process has
fast kernels from its first call on, and a run's numbers never depend on when compiling set in.
"""

import fcntl
import functools
import hashlib
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from abcd_ns.engine.rasterizer import binning, torch_kernels

FOLDER_VARIABLE = "ABCD_KERNELS"
"""Environment variable that names another folder for built kernels."""


class _Forward(torch.nn.Module):
    """`forward_chunk` with a window, at one tile side; exporting wants a module."""

    def __init__(self, side: int) -> None:
        super().__init__()
        self.side = side

    def forward(self, params: Tensor, origins: Tensor, state: Tensor, window: Tensor) -> Tensor:
        return torch_kernels.forward_chunk(params, origins, state, window, self.side)


class _Backward(torch.nn.Module):
    """`backward_chunk` with a window and absolute gradients, at one tile side."""

    def __init__(self, side: int) -> None:
        super().__init__()
        self.side = side

    def forward(
        self, params: Tensor, origins: Tensor, state: Tensor, upstream: Tensor, window: Tensor
    ) -> Tensor:
        return torch_kernels.backward_chunk(params, origins, state, upstream, window, self.side, True)


@dataclass(frozen=True)
class BuiltKernels:
    """Both kernels, for float32 on the CPU. Arguments must be contiguous and at least two tiles wide."""

    forward: Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]
    """(params with ALWAYS, origins, state, window) -> state."""
    backward: Callable[[Tensor, Tensor, Tensor, Tensor, Tensor], Tensor]
    """(params with ALWAYS, origins, state, upstream, window) -> gradients, absolute ones included."""


def kernels_folder() -> Path:
    """Where built kernels are kept."""
    if FOLDER_VARIABLE in os.environ:
        return Path(os.environ[FOLDER_VARIABLE])
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "abcd_ns" / "kernels"


def can_build() -> bool:
    """Whether a C++ compiler is found."""
    return any(shutil.which(name) for name in (os.environ.get("CXX", "g++"), "g++", "clang++"))


@functools.cache
def load_kernels(side: int, chunk: int) -> BuiltKernels | None:
    """The kernels that were built for this machine, or None. A file that cannot be loaded counts as none."""
    paths = _paths(side, chunk)
    if not all(path.is_file() for path in paths):
        return None
    try:
        return BuiltKernels(*map(_load, paths))
    # TypeError, AttributeError: the loader is torch's own, and other versions may call it otherwise.
    except (RuntimeError, OSError, ValueError, TypeError, AttributeError) as error:
        warnings.warn(f"built kernels in {kernels_folder()} cannot be loaded: {error}", stacklevel=2)
        return None


def build_kernels(side: int, chunk: int) -> BuiltKernels | None:
    """Build the kernels in a process of their own, unless they are there, and load them.

    None where there is no C++ compiler, and, with a warning, where building fails.
    """
    loaded = load_kernels(side, chunk)
    if loaded is not None or not can_build():
        return loaded
    command = [sys.executable, "-m", "abcd_ns.engine.rasterizer.built_kernels", str(side), str(chunk)]
    # In this process the compiler would cost seconds of imports, and memory that is never given back.
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    if run.returncode != 0:
        reason = (run.stderr.strip().splitlines() or ["no output"])[-1]
        warnings.warn(f"building kernels failed, the torch rasterizer stays slow: {reason}", stacklevel=2)
    load_kernels.cache_clear()
    return load_kernels(side, chunk)


def _load(path: Path) -> Callable[..., Tensor]:
    # torch._inductor.aoti_load_package makes the same loader, but imports the compiler first.
    loader = torch._C._aoti.AOTIModelPackageLoader(str(path), "model", False, 1, -1)
    return lambda *tensors: loader.run(list(tensors))[0]


def _build_both(side: int, chunk: int) -> None:
    kernels_folder().mkdir(parents=True, exist_ok=True)
    forward, backward = _paths(side, chunk)
    with _one_builder():
        _build(_Forward(side), ("params", "origins", "state", "window"), side, chunk, forward)
        names = ("params", "origins", "state", "upstream", "window")
        _build(_Backward(side), names, side, chunk, backward)


def _build(kernel: torch.nn.Module, names: tuple[str, ...], side: int, chunk: int, path: Path) -> None:
    if path.is_file():
        return
    tiles, pixels = 64, side * side
    shapes = {
        "params": (torch_kernels.ALWAYS + 1, chunk, tiles),
        "origins": (2, tiles),
        "state": (torch_kernels.STATE_PLANES, pixels, tiles),
        "upstream": (5, pixels, tiles),
        "window": (2, pixels, tiles),
    }
    examples = tuple(torch.rand(shapes[name]) for name in names)
    width = torch.export.Dim("width", min=2, max=2**30)
    dynamic = tuple({len(shapes[name]) - 1: width} for name in names)
    exported = torch.export.export(kernel, examples, dynamic_shapes=dynamic)
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        package = torch._inductor.aoti_compile_and_package(
            exported, package_path=str(Path(folder) / "kernel.pt2")
        )
        os.replace(package, path)


def _paths(side: int, chunk: int) -> tuple[Path, Path]:
    """Named after all that the machine code depends on."""
    digest = hashlib.blake2b(digest_size=10)
    for part in (torch.__version__, platform.machine(), _processor(), str(side), str(chunk)):
        digest.update(part.encode() + b"\0")
    for module in (torch_kernels, binning):
        digest.update(Path(module.__file__).read_bytes())
    stem = kernels_folder() / digest.hexdigest()
    return stem.with_suffix(".forward.pt2"), stem.with_suffix(".backward.pt2")


@functools.cache
def _processor() -> str:
    """The processor's instruction sets; code built for one may not run on another."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line for line in lines if line.startswith(("flags", "Features"))), platform.processor())


@contextmanager
def _one_builder() -> Iterator[None]:
    """Wait until no other process builds."""
    with open(kernels_folder() / "lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


if __name__ == "__main__":
    _build_both(int(sys.argv[1]), int(sys.argv[2]))
