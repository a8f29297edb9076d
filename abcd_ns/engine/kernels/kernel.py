"""A function of tensors that runs eagerly anywhere, and as one fused loop where it has been built.

Run as they are, torch functions write every intermediate value to memory and pay for each operation's call;
with some thousand Gaussians the calls cost more than the arithmetic. `build.py` compiles each kernel into a
shared library, once per machine; loading one takes milliseconds.
"""

import functools
import hashlib
import inspect
import os
import platform
import shutil
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

FOLDER_VARIABLE = "ABCD_KERNELS"
"""Environment variable that names another folder for built kernels."""

COMPILER_OPTIONS = {"cpp.dynamic_threads": True}
"""Inductor's. Its default fixes the number of threads when the kernel is built; a process that was told to
use one would still wait for others, and two processes on a machine would wait for each other."""

Run = Callable[..., tuple[Tensor, ...]]

SMALLEST = 2
"""Dynamic sizes below this run eagerly: a compiler may treat a size of 1 as broadcast."""


@dataclass(frozen=True)
class Kernel:
    """Arithmetic on float tensors; integers are bound beforehand.

    A built kernel serves contiguous float32 tensors on the CPU whose dynamic sizes are all 2 or more;
    everything else runs eagerly. Both agree to rounding.
    """

    name: str
    """Of the file; must tell kernels with different bound arguments apart."""
    function: Callable[..., tuple[Tensor, ...]]
    """Without data-dependent control flow; may use torch.func. Returns a tuple."""
    shapes: tuple[str, ...]
    """Of each argument, as "11 n" or "3 n+10": numbers are fixed sizes, names are dynamic ones."""
    depends: tuple[str, ...] = ()
    """Other source files, whose constants or functions the kernel uses."""

    def __call__(self, *tensors: Tensor, built: bool = True) -> tuple[Tensor, ...]:
        """Run, from machine code if that is wanted, there, and suits the tensors."""
        if built and self.suits(*tensors):
            return _load(self)(*tensors)
        return self.function(*tensors)

    def suits(self, *tensors: Tensor) -> bool:
        """Whether machine code is there and serves these tensors."""
        sizes = (tensors[argument].shape[axis] for argument, axis in self._dynamic)
        return all(map(_is_plain, tensors)) and min(sizes) >= SMALLEST and self.is_built

    @functools.cached_property
    def _dynamic(self) -> tuple[tuple[int, int], ...]:
        """(argument, axis) of each dynamic size."""
        sizes = (
            (i, axis, size) for i, shape in enumerate(self.shapes) for axis, size in enumerate(shape.split())
        )
        return tuple((i, axis) for i, axis, size in sizes if not size.isdigit())

    @property
    def is_built(self) -> bool:
        """Whether machine code is there for this machine."""
        return _load(self) is not None

    @property
    def path(self) -> Path:
        """Where its machine code is or would be: a name made of all that the code depends on."""
        return kernels_folder() / f"{self.name}-{_digest(self)}.pt2"


def kernels_folder() -> Path:
    """Where built kernels are kept."""
    if FOLDER_VARIABLE in os.environ:
        return Path(os.environ[FOLDER_VARIABLE])
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "abcd_ns" / "kernels"


def find_compiler() -> str | None:
    """The C++ compiler that is found, by its name."""
    return next(filter(shutil.which, (os.environ.get("CXX") or "g++", "g++", "clang++")), None)


def forget_loaded() -> None:
    """Look at the files again: some may have been built since."""
    _load.cache_clear()


def _is_plain(tensor: Tensor) -> bool:
    return tensor.dtype == torch.float32 and tensor.device.type == "cpu" and tensor.is_contiguous()


@functools.cache
def _load(kernel: Kernel) -> Run | None:
    """The machine code, or None. A file that cannot be loaded counts as none, with a warning."""
    path = kernel.path
    if not path.is_file():
        return None
    try:
        # torch._inductor.aoti_load_package makes the same loader, but imports the compiler first.
        loader = torch._C._aoti.AOTIModelPackageLoader(str(path), "model", False, 1, -1)
    # TypeError, AttributeError: the loader is torch's own, and other versions may call it otherwise.
    except (RuntimeError, OSError, ValueError, TypeError, AttributeError) as error:
        warnings.warn(f"the built kernel {path} cannot be loaded: {error}", stacklevel=2)
        return None
    return lambda *tensors: tuple(loader.run(list(tensors)))


@functools.cache
def _digest(kernel: Kernel) -> str:
    digest = hashlib.blake2b(digest_size=10)
    for part in (
        torch.__version__,
        platform.machine(),
        _processor(),
        repr(kernel.shapes),
        repr(COMPILER_OPTIONS),
    ):
        digest.update(part.encode() + b"\0")
    function = kernel.function
    while isinstance(function, functools.partial):
        function = function.func
    for source in (inspect.getfile(inspect.unwrap(function)), *kernel.depends):
        digest.update(Path(source).read_bytes())
    return digest.hexdigest()


@functools.cache
def _processor() -> str:
    """The processor's instruction sets; code built for one may not run on another."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line for line in lines if line.startswith(("flags", "Features"))), platform.processor())
