"""The packages that training needs: their versions, and whether they start."""

import importlib
import platform
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import entry_points

from abcd_ns import __version__
from abcd_ns.cli.train import find_ns_train
from abcd_ns.errors import IMPORT_TROUBLE
from abcd_ns.machine import own_commit, package_version

VERSIONS = ("torch", "torchvision", "nerfstudio", "gsplat", "viser", "pycolmap", "numpy", "pillow")
"""Distributions that are listed."""
RAY = "ray"
"""What workers need, an extra."""
STARTED = ("torch", "torchvision", "cv2", "pycolmap", "gsplat", "abcd_ns.nerfstudio.method_configs")
"""Modules that are imported, each after what it needs. The last one brings nerfstudio."""
EXPORT = "open3d"
"""What `ns-export` needs besides; heavy, so imported in a process of its own."""


@dataclass(frozen=True)
class Packages:
    """The Python environment."""

    abcd_ns: str
    commit: str | None
    python: str
    versions: dict[str, str | None]
    """By distribution; None where it is not installed."""
    ray: str | None
    """Its version; None where it is not installed."""
    broken: dict[str, str]
    """The error with which a module's import ends, by module."""
    registered: bool
    """Whether nerfstudio finds this package's methods."""
    has_ns_train: bool
    """Whether the command lies beside this Python, or else on the PATH."""


def look_at_packages(done: Callable[[], None]) -> Packages:
    """Try everything.

    Args:
        done: called after each of `len(STARTED) + 1` imports.
    """
    broken = {}
    for module in (*STARTED, EXPORT):
        error = _start_apart(module) if module == EXPORT else _start(module)
        if error is not None:
            broken[module] = error
        done()
    methods = {entry.name for entry in entry_points(group="nerfstudio.method_configs")}
    return Packages(
        abcd_ns=__version__,
        commit=own_commit(),
        python=platform.python_version(),
        versions={name: package_version(name) for name in VERSIONS},
        ray=package_version(RAY),
        broken=broken,
        registered="abcd" in methods,
        has_ns_train=find_ns_train() is not None,
    )


def _start(module: str) -> str | None:
    """Import it; the error, if any."""
    try:
        importlib.import_module(module)
    except IMPORT_TROUBLE as error:
        return f"{type(error).__name__}: {error}".splitlines()[0]
    return None


def _start_apart(module: str) -> str | None:
    """As `_start`, without its memory and its output."""
    command = [sys.executable, "-c", f"import {module}"]
    try:
        run = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    except (OSError, subprocess.SubprocessError) as error:
        return str(error)
    return None if run.returncode == 0 else (run.stderr.strip().splitlines() or ["it crashed"])[-1]
