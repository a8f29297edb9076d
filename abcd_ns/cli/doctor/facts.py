"""All that `abcd doctor` knows of a machine. Looking compiles nothing and writes nothing."""

import importlib
import os
import platform
import shutil
import subprocess
import sys
import warnings
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import psutil
from rich.console import Console
from rich.progress import track

from abcd_ns import __version__
from abcd_ns.cli.doctor.kernels import look_at_kernels
from abcd_ns.cli.train import find_ns_train
from abcd_ns.errors import IMPORT_TROUBLE, first_line
from abcd_ns.machine import describe_machine, output_of, own_commit, package_version
from abcd_ns.units import bytes_in_words

PACKAGES = ("torch", "torchvision", "nerfstudio", "gsplat", "viser", "pycolmap", "numpy", "pillow")
"""Distributions that training needs."""
OURS = "abcd_ns.nerfstudio.method_configs"
"""The module that brings nerfstudio."""
EXPORT = "open3d"
"""What `ns-export` and `abcd mesh` need besides; heavy, so imported in a process of its own."""
STARTED = ("torch", "torchvision", "cv2", "pycolmap", "gsplat", OURS, EXPORT)
"""Modules that are imported, each after what it needs."""


@dataclass(frozen=True)
class Facts:
    """The machine and the environment. Where torch does not start, what it tells is left at its default."""

    abcd_ns: str
    """Version and commit."""
    python: str
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
    may_write: bool
    driver: str | None
    """Of an NVIDIA device, whether torch sees it or not."""
    cpu: str | None = None
    """None where torch does not start."""
    cores: int = 0
    """That this process may use."""
    gpu: str | None = None
    """Name, memory and capability of the device that training takes."""
    gpus: int = 0
    torch_cuda: str | None = None
    """The CUDA version that torch was built for."""
    folder: str | None = None
    """Of the CPU rasterizer's library; None where torch or abcd_ns do not start."""
    built: bool = False
    """Whether that library is there."""
    gsplat: str | None = None
    """gsplat's compiled extension."""
    compiler: str | None = None
    nvcc: str | None = None
    ninja: bool = False
    self_check: dict[str, float] = field(default_factory=dict)
    """By rasterizer and device, the largest relative difference to the reference."""
    failed: dict[str, str] = field(default_factory=dict)
    """Likewise, what is wrong with one."""
    lpips_missing: str | None = None
    """Why LPIPS cannot be computed, if so."""


def gather() -> Facts:
    """Look at everything."""
    bar = {"console": Console(stderr=True), "transient": True}
    tried = {module: _start(module) for module in track(STARTED, "Looking at this machine", **bar)}
    broken = {module: error for module, error in tried.items() if error is not None}
    memory, place = psutil.virtual_memory(), Path("outputs") if Path("outputs").is_dir() else Path()
    number, plus, changes = (own_commit() or "").partition("+")
    driver = output_of("nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader")
    seen = {} if "torch" in broken else _seen_by_torch()
    if not broken.keys() & {"torch", OURS}:
        seen |= look_at_kernels(on_gpu=seen["gpu"] is not None)
    return Facts(
        abcd_ns=__version__ + (f", commit {number[:10]}{plus}{changes}" if number else ""),
        python=platform.python_version(),
        versions={name: package_version(name) for name in PACKAGES},
        ray=package_version("ray"),
        broken=broken,
        registered="abcd" in {entry.name for entry in entry_points(group="nerfstudio.method_configs")},
        has_ns_train=find_ns_train() is not None,
        os=f"{platform.system()} {platform.release()} {platform.machine()}",
        ram_bytes=memory.total,
        ram_free_bytes=memory.available,
        disk_free_bytes=shutil.disk_usage(place).free,
        may_write=os.access(place, os.W_OK),
        driver=driver.split()[0] if driver else None,
        **seen,
    )


def _start(module: str) -> str | None:
    """Import it; the error, if any."""
    if module == EXPORT:
        return _start_apart(module)
    try:
        importlib.import_module(module)
    except IMPORT_TROUBLE as error:
        return f"{type(error).__name__}: {first_line(error)}"
    return None


def _start_apart(module: str) -> str | None:
    command = [sys.executable, "-c", f"import {module}"]
    try:
        run = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    except (OSError, subprocess.SubprocessError) as error:
        return str(error)
    return None if run.returncode == 0 else (run.stderr.strip().splitlines() or ["it crashed"])[-1]


def _seen_by_torch() -> dict[str, Any]:
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
