"""Compiles kernels ahead of time: `torch.export` and AOTInductor turn each into one shared library.

A minute or two on two cores for all of them, once per machine. Every later process has fast kernels from its
first call on, so a run's numbers never depend on when compiling set in.
"""

import fcntl
import os
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch

from abcd_ns.engine.kernels.kernel import (
    COMPILER_OPTIONS,
    SMALLEST,
    Kernel,
    find_compiler,
    forget_loaded,
    kernels_folder,
)

BUILDER = "abcd_ns.engine.build_kernels"
"""The module that knows all kernels. By name, as it imports the kernels' owners, and they import this."""


def build_kernels(kernels: Sequence[Kernel], side: int, chunk: int, primitive: str = "3dgs") -> None:
    """Build what is missing, in a process of its own. Without a C++ compiler nothing happens.

    In this process the compiler would cost seconds of imports, and memory that is never given back. Where
    building fails a warning says so: the kernels stay eager.

    Args:
        kernels: what is wanted; the process builds all kernels for the other arguments, see BUILDER.
    """
    if all(kernel.is_built for kernel in kernels) or find_compiler() is None:
        return
    command = [sys.executable, "-m", BUILDER, str(side), str(chunk), primitive]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    if run.returncode != 0:
        reason = (run.stderr.strip().splitlines() or [f"exit code {run.returncode}"])[-1]
        warnings.warn(f"building kernels failed, the torch rasterizer stays slow: {reason}", stacklevel=2)
    forget_loaded()


def compile_all(kernels: Sequence[Kernel]) -> None:
    """Compile what is missing, on all cores; waits for another process that is at it."""
    with _one_builder():
        # Threads share the compiler's state, so processes it is.
        workers = min(len(kernels), os.cpu_count() or 1)
        with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
            list(pool.map(compile_kernel, kernels))


def compile_kernel(kernel: Kernel) -> None:
    """Write the kernel's machine code to its path, unless it is there."""
    from torch.fx.experimental.proxy_tensor import make_fx  # imports most of the compiler

    if kernel.path.is_file():
        return
    examples = tuple(torch.rand([_example_size(size) for size in shape.split()]) for shape in kernel.shapes)
    # Traced first, because torch.export does not look through torch.func.
    traced = make_fx(lambda *tensors: kernel.function(*tensors), tracing_mode="symbolic")(*examples)
    exported = torch.export.export(traced, examples, dynamic_shapes=_dynamic_shapes(kernel))
    with tempfile.TemporaryDirectory(dir=kernel.path.parent) as folder:
        package = torch._inductor.aoti_compile_and_package(
            exported, package_path=str(Path(folder) / "kernel.pt2"), inductor_configs=dict(COMPILER_OPTIONS)
        )
        os.replace(package, kernel.path)


def _dynamic_shapes(kernel: Kernel) -> tuple[dict[int, Any], ...]:
    """Of each argument, the axes whose size is dynamic, as torch.export wants them."""
    dims: dict[str, Any] = {}

    def dim(size: str) -> Any:
        name, _, more = size.partition("+")
        found = dims.setdefault(name, torch.export.Dim(name, min=SMALLEST, max=2**30))
        return found + int(more) if more else found

    return tuple(
        {axis: dim(size) for axis, size in enumerate(shape.split()) if not size.isdigit()}
        for shape in kernel.shapes
    )


def _example_size(size: str) -> int:
    """A dynamic size's example: any number that equals no other size, lest a compiler takes both for one."""
    if size.isdigit():
        return int(size)
    name, _, more = size.partition("+")
    return 64 + sum(map(ord, name)) + int(more or 0)


@contextmanager
def _one_builder() -> Iterator[None]:
    """Wait until no other process builds."""
    kernels_folder().mkdir(parents=True, exist_ok=True)
    with open(kernels_folder() / "lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
