"""Compiles `cpp/native.cpp` at first use, some fifteen seconds once a machine, and loads it by ctypes.

Where there is no compiler, or it fails, one warning says so, and torch does the work, slowly.
"""

import ctypes
import fcntl
import functools
import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
import warnings
from pathlib import Path

import torch
from torch import Tensor

from abcd_ns.machine import proc_value, threads_wanted

FOLDER_VARIABLE = "ABCD_KERNELS"
"""Environment variable that names another folder for the compiled library."""
SOURCES = Path(__file__).parent / "cpp"
FLAGS = ("-std=c++17", "-O3", "-fno-math-errno", "-fno-trapping-math", "-shared", "-fPIC", "-pthread")
TUNED = ("-march=native",), ("-mcpu=native",), ()
"""Further flags, the best first; not every compiler knows each for every processor."""
SECONDS = 300
"""After which a compiler is given up."""
_POINTER, _INT, _LONG, _FLOAT = ctypes.c_void_p, ctypes.c_int, ctypes.c_int64, ctypes.c_float
ARGUMENTS = {
    "threads": [_INT],
    "project": [_INT, *[_POINTER] * 2, _LONG, _POINTER],
    "project_back": [_INT, *[_POINTER] * 2, _LONG, *[_POINTER] * 2],
    "lists": [_INT, _POINTER, _LONG, _POINTER, _LONG, _INT],
    "free": [_POINTER],
    "draw": [*[_POINTER] * 3, _INT],
    "draw_back": [_POINTER, _LONG, *[_POINTER] * 5, _LONG],
    "windows": [_POINTER, _FLOAT, *[_POINTER] * 4],
    "members": [_POINTER] * 3,
    "deepen": [_POINTER] * 3,
    "photometric": [*[_POINTER] * 2, *[_LONG] * 2, *[_POINTER] * 3],
    "between": [_LONG, *[_POINTER] * 2],
    "between_back": [_LONG, *[_POINTER] * 2, _FLOAT, *[_POINTER] * 3],
    "residual": [_LONG, *[_POINTER] * 4],
    "adam": [_LONG, *[_POINTER] * 4, *[_FLOAT] * 5],
    "worth": [_LONG, *[_POINTER] * 5, _LONG, _FLOAT, _POINTER, *[_LONG] * 2],
}
"""Of the library's functions, whose names have `abcd_` before them."""


def kernels_folder() -> Path:
    """Where compiled libraries are kept."""
    if FOLDER_VARIABLE in os.environ:
        return Path(os.environ[FOLDER_VARIABLE])
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "abcd_ns" / "kernels"


def find_compiler() -> str | None:
    """The C++ compiler that is found, by its name."""
    return next(filter(shutil.which, (os.environ.get("CXX") or "g++", "g++", "clang++")), None)


def library_path() -> Path:
    """Where the library is or would be: a name made of all that the code depends on."""
    digest = hashlib.blake2b(digest_size=10)
    # Code made for some instructions does not run on a processor of others.
    instructions = proc_value("cpuinfo", "flags", "Features") or platform.processor()
    for part in (platform.machine(), instructions, find_compiler() or "", *FLAGS):
        digest.update(part.encode() + b"\0")
    for source in sorted(SOURCES.iterdir()):
        digest.update(source.read_bytes())
    return kernels_folder() / f"native-{digest.hexdigest()}.so"


@functools.cache
def library() -> ctypes.CDLL | None:
    """The library, compiled if need be; None, with a warning, where that fails."""
    try:
        path = library_path()
        if not path.is_file():
            _compile(path)
        found = ctypes.CDLL(str(path))
    except (OSError, subprocess.SubprocessError) as error:
        reason = getattr(error, "stderr", None) or str(error)
        warnings.warn(
            f"The CPU rasterizer runs in torch, 20 times slower: {_first_line(reason)}", stacklevel=2
        )
        return None
    for name, arguments in ARGUMENTS.items():
        getattr(found, f"abcd_{name}").argtypes = arguments
    found.abcd_lists.restype = _POINTER
    found.abcd_residual.restype = ctypes.c_double
    found.abcd_threads(threads_wanted())
    return found


def share_cores(threads: int) -> None:
    """Let this process compute on so many threads, which sleep while they wait.

    Torch gets one where the library is there: its own wait by spinning. One other busy process on the machine
    then stops them all.
    """
    found = library()
    if found is not None:
        found.abcd_threads(threads)
    torch.set_num_threads(1 if found is not None else threads)


def suits(*tensors: Tensor) -> bool:
    """Whether the library is there and takes these."""
    plain = all(tensor.dtype == torch.float32 and tensor.device.type == "cpu" for tensor in tensors)
    return plain and library() is not None


def address(tensor: Tensor | None) -> int | None:
    """Of a contiguous tensor, for a call."""
    return None if tensor is None else tensor.data_ptr()


def _compile(path: Path) -> None:
    """Write the library to `path`; waits for another process that is at it."""
    compiler = find_compiler()
    if compiler is None:
        raise OSError("no C++ compiler was found; install g++ (apt-get install g++)")
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path.parent / "lock", "w") as lock, tempfile.TemporaryDirectory(dir=path.parent) as folder:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if path.is_file():
            return
        made = Path(folder) / path.name
        for tuned in TUNED:
            command = [compiler, *FLAGS, *tuned, str(SOURCES / "native.cpp"), "-o", str(made)]
            options = {"capture_output": True, "text": True, "timeout": SECONDS}
            run = subprocess.run(command, check=not tuned, **options)
            if run.returncode == 0:
                break
        os.replace(made, path)


def _first_line(reason: str) -> str:
    lines = [line for line in reason.splitlines() if line.strip()]
    return next((line for line in lines if "error" in line), lines[0] if lines else "no reason given")
