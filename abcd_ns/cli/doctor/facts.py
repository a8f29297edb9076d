"""All that `abcd doctor` knows of a machine. Looking compiles nothing and writes nothing."""

import importlib.util
import logging
import os
import platform
import re
import shutil
import subprocess
import sys
import warnings
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import psutil

from abcd_ns import __version__
from abcd_ns.cli.train import find_tool
from abcd_ns.errors import IMPORT_TROUBLE, first_line
from abcd_ns.machine import describe_machine, output_of, own_commit, package_version
from abcd_ns.progress_bar import tracked
from abcd_ns.units import bytes_in_words

PACKAGES = ("torch", "torchvision", "nerfstudio", "gsplat", "viser", "pycolmap", "numpy", "pillow")
"""Distributions that training needs."""
OURS = "abcd_ns.nerfstudio.method_configs"  # the module that brings nerfstudio
EXPORT = "open3d"  # what `ns-export` and `abcd mesh` need besides; heavy, so imported in a process of its own
STARTED = ("torch", "torchvision", "cv2", "pycolmap", "gsplat", OURS, EXPORT)
"""Modules that are imported, each after what it needs."""
COMPILER = "C++ compiler"


@dataclass(frozen=True)
class Facts:
    """The machine and the environment. Where torch does not start, what it tells is left at its default."""

    abcd_ns: str
    """Version and commit, and Python's version."""
    versions: dict[str, str | None]
    """Of PACKAGES; None where one is not installed."""
    ray: str | None
    """Version of what several GPUs need; None where it is not installed."""
    broken: dict[str, str]
    """By module, the error that its import ends with."""
    registered: bool
    """Whether nerfstudio finds the methods of this package."""
    has_ns_train: bool
    os: str
    ram_bytes: int
    ram_free_bytes: int
    disk_free_bytes: int
    """Where `ns-train`, called here, would write."""
    driver: str | None
    """Of an NVIDIA device, whether torch sees it or not."""
    cpu: str | None = None
    cores: int = 0
    gpu: str | None = None
    """Name, memory and capability of the device that training takes."""
    gpus: int = 0
    torch_cuda: str | None = None
    folder: str | None = None
    """Of the CPU rasterizer's library; None where torch or abcd_ns do not start."""
    built: bool = False
    gsplat: str | None = None
    """Its compiled extension."""
    build_tools: dict[str, str | None] = field(default_factory=dict)
    """What compiles it: the version of nvcc, where the others are; None where one is missing."""
    difference: float | None = None
    """The largest relative one of the CPU rasterizer to the reference. Training checks gsplat's."""
    failed: str | None = None
    lpips_missing: str | None = None
    """Why LPIPS cannot be computed, if so."""


def gather() -> Facts:
    """Look at everything."""
    tried = {module: _start(module) for module in tracked(STARTED, "Looking at this machine")}
    broken = {module: error for module, error in tried.items() if error is not None}
    memory, place = psutil.virtual_memory(), Path("outputs") if Path("outputs").is_dir() else Path()
    number, plus, changes = (own_commit() or "").partition("+")
    commit = f", commit {number[:10]}{plus}{changes}" if number else ""
    driver = output_of("nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader")
    return Facts(
        abcd_ns=f"{__version__}{commit}; Python {platform.python_version()}",
        versions={name: package_version(name) for name in PACKAGES},
        ray=package_version("ray"),
        broken=broken,
        registered="abcd" in entry_points(group="nerfstudio.method_configs").names,
        has_ns_train=find_tool("ns-train") is not None,
        os=f"{platform.system()} {platform.release()} {platform.machine()}",
        ram_bytes=memory.total,
        ram_free_bytes=memory.available,
        disk_free_bytes=shutil.disk_usage(place).free,
        driver=driver.split()[0] if driver else None,
        **({} if "torch" in broken else _seen_by_torch()),
        **({} if broken.keys() & {"torch", OURS} else _kernels()),
    )


def _start(module: str) -> str | None:
    """Import it; the error, if any."""
    if module == EXPORT:
        command = [sys.executable, "-c", f"import {module}"]
        run = subprocess.run(command, capture_output=True, text=True, check=False)
        return None if run.returncode == 0 else (run.stderr.strip().splitlines() or ["it crashed"])[-1]
    try:
        importlib.import_module(module)
    except IMPORT_TROUBLE as error:
        return f"{type(error).__name__}: {first_line(error)}"
    return None


def _seen_by_torch() -> dict[str, Any]:
    """The fields of Facts from `cpu` to `torch_cuda`."""
    import torch

    machine, gpu = describe_machine(), None
    with warnings.catch_warnings():  # an old driver is a finding of ours
        warnings.simplefilter("ignore")
        if torch.cuda.is_available():
            found = torch.cuda.get_device_properties(torch.cuda.current_device())
            memory = bytes_in_words(found.total_memory)
            gpu = f"{found.name}, {memory}, capability {found.major}.{found.minor}"
    known = {"gpu": gpu, "gpus": torch.cuda.device_count(), "torch_cuda": torch.version.cuda}
    return {"cpu": machine.cpu, "cores": machine.cores, **known}


def _kernels() -> dict[str, Any]:
    """The fields of Facts from `folder` on."""
    from abcd_ns.engine.kernels.native import find_compiler, kernels_folder, library_path
    from abcd_ns.engine.render import TorchRasterizer, self_check
    from abcd_ns.nerfstudio.metrics import lpips_missing

    extension, built = find_extension(), library_path().is_file()
    nvcc = re.search(r"release ([\d.]+)", output_of("nvcc", "--version") or "")
    difference, failed = None, None
    try:
        difference = self_check(TorchRasterizer(use_native=built), "cpu")
    except (RuntimeError, OSError, AttributeError) as error:
        failed = first_line(error)
    return {
        "folder": str(kernels_folder()),
        "built": built,
        "gsplat": extension and str(extension),
        "build_tools": {"nvcc": nvcc and nvcc[1], "ninja": shutil.which("ninja"), COMPILER: find_compiler()},
        "difference": difference,
        "failed": failed,
        "lpips_missing": lpips_missing(),
    }


def find_extension() -> Path | None:
    """gsplat's CUDA kernels, from its wheel or from an earlier run."""
    import torch

    # Its import says that there is no GPU, where there is none.
    logging.getLogger("torch.utils.cpp_extension").setLevel(logging.ERROR)
    from torch.utils.cpp_extension import get_default_build_root

    package = importlib.util.find_spec("gsplat")
    folders = package.submodule_search_locations if package else []
    # torch's own `_get_build_directory` would make the folder.
    kind = f"cu{torch.version.cuda.replace('.', '')}" if torch.version.cuda else "cpu"
    of_this_python = f"py{sys.version_info.major}{sys.version_info.minor}{sys.abiflags}_{kind}"
    default = Path(get_default_build_root()) / of_this_python
    built = Path(os.environ.get("TORCH_EXTENSIONS_DIR") or default) / "gsplat_cuda/gsplat_cuda.so"
    found = [*(path for folder in folders for path in Path(folder).glob("csrc*.so")), built]
    return next((path for path in found if path.is_file()), None)
