"""The compiled code that training runs on: what is built, what could be, and whether it computes right.

Nothing is built here, and no folder is made.
"""

import importlib.util
import logging
import os
import re
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

from abcd_ns.machine import output_of

EXTENSION = "gsplat_cuda"
"""gsplat's name for what it compiles at first use."""


@dataclass(frozen=True)
class Kernels:
    """The native library of the CPU rasterizer, and gsplat's kernels for CUDA."""

    built: bool
    """Whether the native library is there."""
    folder: str
    """Of the native library."""
    compiler: str | None
    """C++, for either kind."""
    gsplat: str | None
    """gsplat's built extension."""
    nvcc: str | None
    """Version of the CUDA compiler on the PATH."""
    ninja: bool
    """Whether the build tool that gsplat's build needs is on the PATH."""
    self_check: dict[str, float]
    """Largest relative difference to the reference, by rasterizer and device."""
    failed: dict[str, str]
    """What is wrong with a rasterizer, likewise."""
    lpips_missing: str | None
    """Why LPIPS cannot be computed, if so."""


def look_at_kernels(on_gpu: bool) -> Kernels:
    """Needs a torch that starts.

    Args:
        on_gpu: whether there is a CUDA device to check gsplat's kernels on.
    """
    from abcd_ns.engine.kernels import find_compiler, kernels_folder
    from abcd_ns.engine.kernels.native import library_path
    from abcd_ns.nerfstudio.metrics import lpips_missing

    extension, built = find_extension(), library_path().is_file()
    agree, failed = _self_checks(built, extension if on_gpu else None)
    return Kernels(
        built=built,
        folder=str(kernels_folder()),
        compiler=find_compiler(),
        gsplat=None if extension is None else str(extension),
        nvcc=_nvcc(),
        ninja=shutil.which("ninja") is not None,
        self_check=agree,
        failed=failed,
        lpips_missing=lpips_missing(),
    )


def find_extension() -> Path | None:
    """gsplat's CUDA kernels, from its wheel or from an earlier run."""
    package = importlib.util.find_spec("gsplat")
    for folder in (package.submodule_search_locations or ()) if package else ():
        for path in sorted(Path(folder).glob("csrc*.so")):
            return path
    path = build_folder() / f"{EXTENSION}.so"
    return path if path.is_file() else None


def build_folder() -> Path:
    """Where torch compiles gsplat's extension. Its own `_get_build_directory` would make the folder."""
    import torch

    # Its import says that there is no GPU, where there is none.
    logging.getLogger("torch.utils.cpp_extension").setLevel(logging.ERROR)
    from torch.utils.cpp_extension import get_default_build_root

    if root := os.environ.get("TORCH_EXTENSIONS_DIR"):
        return Path(root) / EXTENSION
    cuda, hip = torch.version.cuda, torch.version.hip
    kind = f"rocm{hip.replace('.', '')}" if hip else f"cu{cuda.replace('.', '')}" if cuda else "cpu"
    python = f"py{sys.version_info.major}{sys.version_info.minor}{sys.abiflags}"
    return Path(get_default_build_root()) / f"{python}_{kind}" / EXTENSION


def _self_checks(built: bool, extension: Path | None) -> tuple[dict[str, float], dict[str, str]]:
    """Differences and faults by rasterizer: the CPU's, and gsplat's where its kernels are built."""
    from abcd_ns.engine.render import TorchRasterizer, self_check

    checks = {"torch on cpu": lambda: self_check(TorchRasterizer(use_native=built), "cpu")}
    if extension is not None:
        checks["gsplat on cuda"] = lambda: _check_gsplat(extension)
    agree, failed = {}, {}
    for name, check in checks.items():
        try:
            agree[name] = check()
        except (RuntimeError, ImportError, OSError, AttributeError) as error:
            failed[name] = (str(error) or repr(error)).splitlines()[0]
    return agree, failed


def _check_gsplat(extension: Path) -> float:
    from abcd_ns.engine.render import self_check

    _use(extension)
    from abcd_ns.engine.render.cuda.backend import GsplatRasterizer

    return self_check(GsplatRasterizer(), "cuda")


def _use(extension: Path) -> None:
    """Have gsplat take this file. Its own loader compiles anew where it thinks that something changed."""
    if extension.stem != EXTENSION or "gsplat.cuda._backend" in sys.modules:
        return
    spec = importlib.util.spec_from_file_location(EXTENSION, extension)
    backend = ModuleType("gsplat.cuda._backend")
    backend._C = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(backend._C)
    sys.modules[backend.__name__] = backend


def _nvcc() -> str | None:
    said = output_of("nvcc", "--version")
    if said is None:
        return None
    found = re.search(r"release ([\d.]+)", said)
    return found.group(1) if found else "unknown"
