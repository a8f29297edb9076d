"""`abcd doctor`: what this machine and environment are, whether they can train, and what to do where not.

Looking compiles nothing and writes nothing.
"""

import importlib.util
import logging
import os
import platform
import re
import shutil
import subprocess
import sys
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import psutil
from rich.console import Console

from abcd_ns import __version__
from abcd_ns.cli.findings import Finding, error, note, print_findings, warning
from abcd_ns.cli.train import find_tool
from abcd_ns.errors import IMPORT_TROUBLE, first_line
from abcd_ns.machine import describe_machine, output_of, own_commit, package_version, without_home
from abcd_ns.progress_bar import tracked
from abcd_ns.terminal import many, print_facts
from abcd_ns.units import GIB, bytes_in_words

PACKAGES = ("torch", "torchvision", "nerfstudio", "gsplat", "viser", "pycolmap", "numpy", "pillow")
"""Distributions that training needs."""
OURS = "abcd_ns.nerfstudio.method_configs"  # the module that brings nerfstudio
EXPORT = "open3d"  # what `ns-export` and `abcd mesh` need besides; heavy, so imported in a process of its own
STARTED = ("torch", "torchvision", "cv2", "pycolmap", "gsplat", OURS, EXPORT)
"""Modules that are imported, each after what it needs."""
COMPILER = "C++ compiler"
MAIN = ("torch", "nerfstudio", "gsplat", "viser")  # packages whose versions are always shown
DETAILS = ("os", "driver", "torch_cuda", "lpips_missing")
"""Facts that only --verbose shows, beside the other packages' versions."""
TESTED = {"nerfstudio": "1.1.5", "gsplat": "1.4.0"}  # versions whose insides are relied on
LITTLE_RAM, LITTLE_DISK = 4 * GIB, 6 * GIB  # free bytes below which runs of usual size end early
SYSTEM_LIBRARIES = "sudo apt-get install libgl1 libegl1 libgomp1 libusb-1.0-0 libx11-6"
NMS = "torchvision::nms"  # in the error of a torchvision that was built for another torch


@dataclass(frozen=True)
class Facts:
    """The machine and the environment. Where torch does not start, what it tells is left at its default."""

    abcd_ns: str  # version and commit, and Python's version
    versions: dict[str, str | None]  # of PACKAGES; None where one is not installed
    ray: str | None  # version of what several GPUs need; None where it is not installed
    broken: dict[str, str]  # by module, the error that its import ends with
    registered: bool  # whether nerfstudio finds the methods of this package
    has_ns_train: bool
    os: str
    ram_bytes: int
    ram_free_bytes: int
    disk_free_bytes: int  # where `ns-train`, called here, would write
    driver: str | None  # of an NVIDIA device, whether torch sees it or not
    cpu: str | None = None
    cores: int = 0
    gpu: str | None = None  # name, memory and capability of the device that training takes
    gpus: int = 0
    torch_cuda: str | None = None
    folder: str | None = None  # of the CPU rasterizer's library; None where torch or abcd_ns do not start
    built: bool = False
    gsplat: str | None = None  # its compiled extension
    build_tools: dict[str, str | None] = field(default_factory=dict)
    """What compiles it: the version of nvcc, where the others are; None where one is missing."""
    difference: float | None = None
    """The largest relative one of the CPU rasterizer to the reference. Training checks gsplat's."""
    failed: str | None = None
    lpips_missing: str | None = None  # why LPIPS cannot be computed, if so


def doctor(*, verbose: bool = False) -> int:
    """Examine this machine: versions, hardware, compiled kernels. Say what to fix.

    Compiles nothing and writes nothing. The output names no user and no home folder, so that it can be copied
    into an issue. The exit code is 1 if training cannot work.

    Args:
        verbose: Show all versions and notes.
    """
    facts, console = gather(), Console()
    findings = diagnose(facts)
    details = facts.versions | facts.build_tools | {name: getattr(facts, name) for name in DETAILS}
    more = {name.replace("_", " "): value or "none" for name, value in details.items() if verbose}
    print_facts({name: without_home(value) for name, value in (_rows(facts) | more).items()}, console)
    shown = [finding for finding in findings if verbose or finding.level != "note"]
    print_findings(shown, console)
    ill = any(finding.level == "error" for finding in findings)
    verdict = "Training cannot work here yet: fix the errors." if ill else "Training can work here."
    if not verbose:
        left = len(findings) - len(shown)
        notes = f" and {many(left, 'note', 'notes')}" if left else ""
        verdict += f" All versions{notes}: abcd doctor --verbose"
    console.print(f"\n{verdict}", highlight=False)
    return int(ill)


def diagnose(facts: Facts) -> list[Finding]:
    """All that is wrong."""
    found = [*_of_packages(facts), *_of_the_machine(facts), *_of_kernels(facts)]
    return [replace(f, what=without_home(f.what), fix=without_home(f.fix)) for f in found]


def _rows(f: Facts) -> dict[str, str]:
    """What is always shown."""
    rows = {
        "abcd_ns": f.abcd_ns,
        "packages": ", ".join(f"{name} {f.versions.get(name) or 'not installed'}" for name in MAIN),
        "GPU": f.gpu or "none: training runs on the CPU, which is meant for small pictures",
        "CPU": f"{f.cpu}, {many(f.cores, 'core', 'cores')}" if f.cpu else "unknown, as torch does not start",
        "RAM": f"{bytes_in_words(f.ram_bytes)}, {bytes_in_words(f.ram_free_bytes)} free",
        "disk": f"{bytes_in_words(f.disk_free_bytes)} free",
        "workers": _workers(f),
    }
    if f.folder is None:
        return rows | {"kernels": "unknown, as packages do not start"}
    checked = "FAILED" if f.difference is None else f"differs by {f.difference:.0e} from the reference"
    return rows | {
        "CPU rasterizer": f"compiled, in {f.folder}" if f.built else "first use compiles it, in 15 s",
        "gsplat's": f.gsplat or "not built",
        "self-check": checked,
    }


def _workers(f: Facts) -> str:
    """How many blocks could be trained at once."""
    if f.gpu and f.gpus > 1:
        how = f"by Ray {f.ray}" if f.ray else "after pip install 'abcd-ns[cluster]'"
        return f"up to {f.gpus}, one for each GPU: ns-train's --pipeline.workers, {how}"
    if f.gpu or f.cores < 2:
        return f"none here: one {'GPU' if f.gpu else 'core'}"
    return f"up to {f.cores}, one for each core, for two blocks each"


def _of_packages(f: Facts) -> Iterator[Finding]:
    if missing := [name for name, version in f.versions.items() if version is None]:
        fix = "In the checkout of abcd_ns: pip install ."
        yield error("missing-packages", f"Not installed: {', '.join(missing)}.", fix)
    for module, why in f.broken.items():
        if module == EXPORT:
            what = f"ns-export and abcd mesh cannot start, as {module} does not: {why}"
            yield warning("broken-export", what, f"On Debian and Ubuntu: {SYSTEM_LIBRARIES}")
        elif NMS in why:
            what = f"torch and torchvision do not belong together: {why}"
            yield error("broken-package", what, "Install both from the same place, of versions that match.")
        else:
            fix = f"Install it again; if a lib*.so is missing, {SYSTEM_LIBRARIES}"
            yield error("broken-package", f"{module} does not start: {why}", fix)
    if not f.registered:
        what = "nerfstudio does not know the methods of abcd_ns: it is not installed in this environment."
        yield error("not-registered", what, "In its checkout: pip install .")
    if not f.has_ns_train:
        fix = "Install nerfstudio into this environment, or activate the one that has it."
        yield error("no-ns-train", "There is no command ns-train beside this Python.", fix)
    for name, tested in TESTED.items():
        version = f.versions[name] or tested
        if version.split("+")[0] != tested:
            what = f"{name} is {version}; abcd_ns was tested with {tested} and relies on its insides."
            yield warning("untested-version", what, f"If something fails, try pip install {name}=={tested}")


def _of_the_machine(f: Facts) -> Iterator[Finding]:
    if f.disk_free_bytes < LITTLE_DISK:
        yield warning(
            "little-disk",
            f"Only {bytes_in_words(f.disk_free_bytes)} of disk are free here. A run's blocks take six times "
            "the size of the scene, and each checkpoint once that.",
            "Make room, or give ns-train --output-dir FOLDER on another disk.",
        )
    if f.ram_free_bytes < LITTLE_RAM:
        yield warning(
            "little-ram",
            f"Only {bytes_in_words(f.ram_free_bytes)} of RAM are free. By default photos, blocks and layers "
            "take up to 8 GiB of it, or 40% of all.",
            "Close other programs, or lower ns-train's --pipeline.ram-budget-gb",
        )
    if f.cpu is None or f.gpu:
        return
    there = f"There is an NVIDIA device (driver {f.driver}), but torch"
    if f.driver is None:
        what = "No CUDA device: training runs on the CPU. That is meant for pictures some 160 to 320 px wide."
        yield note("no-gpu", what)
    elif f.torch_cuda is None:
        fix = "Install torch and torchvision as built for CUDA."
        yield warning("torch-without-cuda", f"{there} is built for the CPU only.", fix)
    else:
        fix = "Update the driver, or install torch for an older CUDA; look at CUDA_VISIBLE_DEVICES."
        yield warning("cuda-unavailable", f"{there}, built for CUDA {f.torch_cuda}, cannot use it.", fix)


def _of_kernels(f: Facts) -> Iterator[Finding]:
    if f.folder is None:
        return
    if f.gpu and f.gsplat is None:
        yield _unbuilt(f)
    if not f.gpu and not f.built and not f.build_tools[COMPILER]:
        what = "There is no C++ compiler for the CPU rasterizer. Training works, some 20 times slower."
        yield warning("no-compiler", what, "Install one: sudo apt-get install g++")
    if f.failed:
        fix = f"Delete {f.folder}, so that its library is compiled anew."
        yield error("self-check", f"The CPU rasterizer: {f.failed}", fix)
    if f.lpips_missing:
        what = f"{f.lpips_missing}. Nothing is downloaded by default. Until then scores are PSNR and SSIM."
        yield note("no-lpips", what)


def _unbuilt(f: Facts) -> Finding:
    """Whether gsplat's kernels, which are not there, can be built."""
    none, nvcc = "gsplat's CUDA kernels are not built.", f.build_tools["nvcc"]
    if missing := ", ".join(name for name, there in f.build_tools.items() if not there):
        what = f"{none} To build them, the PATH lacks {missing}."
        fix = f"Install the CUDA toolkit {f.torch_cuda} (nvcc), g++ and ninja. Or train slowly, with "
        return error("gsplat-cannot-be-built", what, fix + "--pipeline.model.rasterizer torch")
    if nvcc.split(".")[0] != (f.torch_cuda or "").split(".")[0]:
        what = f"{none} nvcc is of CUDA {nvcc}, torch of {f.torch_cuda}: it compiles with no other."
        fix = f"Put the nvcc of CUDA {f.torch_cuda} first on the PATH, or install torch for {nvcc}."
        return error("gsplat-cannot-be-built", what, fix)
    return note(
        "gsplat-not-built",
        f"{none} The first training or `abcd plan` compiles them, once: some 20 minutes of CPU time, spread "
        "over up to 10 processes.",
        "If that takes too much RAM, set MAX_JOBS=2 for it.",
    )


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
