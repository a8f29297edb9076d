"""What is wrong or missing on a machine, and what to do about it."""

import re
from collections.abc import Callable

from abcd_ns.cli.doctor.facts import Facts
from abcd_ns.cli.doctor.packages import EXPORT
from abcd_ns.cli.findings import error, note, warning
from abcd_ns.units import GIB, bytes_in_words

TESTED = {"nerfstudio": "1.1.5", "gsplat": "1.4.0"}
"""Versions whose insides are relied on."""
VISER_MENDED = (1, 0, 25)
"""The first version of viser that serves its own files only."""
LITTLE_RAM, LITTLE_DISK = 4 * GIB, 6 * GIB
"""Free bytes below which runs of usual size end early."""
SYSTEM_LIBRARIES = "sudo apt-get install libgl1 libegl1 libgomp1 libusb-1.0-0 libx11-6"
NMS = "torchvision::nms"
"""In the error of a torchvision that was built for another torch."""


def missing_packages(f: Facts) -> dict[str, str] | None:
    """Names of packages that are not installed."""
    missing = [name for name, version in f.packages.versions.items() if version is None]
    return {"names": ", ".join(missing)} if missing else None


def broken(f: Facts, wanted: Callable[[str, str], bool]) -> list[dict[str, str]]:
    """Modules that do not start, where module and error are as `wanted`."""
    return [{"module": m, "why": why} for m, why in f.packages.broken.items() if wanted(m, why)]


def untested(f: Facts) -> list[dict[str, str]]:
    """Packages of which another version was tested."""
    found = [(name, f.packages.versions.get(name), tested) for name, tested in TESTED.items()]
    return [
        {"name": name, "version": version, "tested": tested}
        for name, version, tested in found
        if version is not None and version.split("+")[0] != tested
    ]


def failed(f: Facts, kind: str) -> list[dict[str, str]]:
    """Rasterizers of this kind that failed the self-check."""
    found = f.kernels.failed if f.kernels else {}
    return [{"name": name, "why": why} for name, why in found.items() if name.startswith(kind)]


def needs_gsplat(f: Facts) -> bool:
    """Whether gsplat's kernels are of use and not built."""
    return f.kernels is not None and f.hardware.gpu is not None and f.kernels.gsplat is None


def missing_tools(f: Facts) -> dict[str, str] | None:
    """Of those that build gsplat's kernels."""
    tools = {"nvcc": f.kernels.nvcc, "ninja": f.kernels.ninja, "a C++ compiler": f.kernels.compiler}
    missing = [name for name, there in tools.items() if not there]
    return {"missing": ", ".join(missing)} if missing else None


def right_nvcc(f: Facts) -> bool:
    """Whether nvcc is of the major version of torch's CUDA."""
    return numbers(f.kernels.nvcc or "")[:1] == numbers(f.hardware.torch_cuda or "")[:1]


def hidden_gpu(f: Facts) -> bool:
    """Whether there is an NVIDIA device that torch does not see."""
    return f.hardware is not None and f.hardware.gpu is None and f.hardware.driver is not None


def needs_library(f: Facts) -> bool:
    """Whether the CPU rasterizer is of use and not compiled."""
    return f.kernels is not None and f.hardware.gpu is None and not f.kernels.built


def little(free: int, wanted: int) -> dict[str, str] | None:
    """The free bytes in words, where they are too few."""
    return {"free": bytes_in_words(free)} if free < wanted else None


def numbers(version: str) -> tuple[int, ...]:
    """ "1.0.25rc1" as (1, 0, 25, 1)."""
    return tuple(map(int, re.findall(r"\d+", version.split("+")[0])))


RULES = (
    error(
        "missing-packages",
        missing_packages,
        "Not installed: {names}.",
        "In the checkout of abcd_ns: pip install .",
    ),
    warning(
        "broken-export",
        lambda f: broken(f, lambda module, _: module == EXPORT),
        "ns-export and abcd mesh cannot start, as {module} does not: {why}",
        f"On Debian and Ubuntu: {SYSTEM_LIBRARIES}",
    ),
    error(
        "broken-package",
        lambda f: broken(f, lambda _, why: NMS in why),
        "torch and torchvision do not belong together: {why}",
        "Install both from the same place, of versions that match.",
    ),
    error(
        "broken-package",
        lambda f: broken(f, lambda module, why: module != EXPORT and NMS not in why),
        "{module} does not start: {why}",
        f"Install it again; if a lib*.so is missing, {SYSTEM_LIBRARIES}",
    ),
    error(
        "not-registered",
        lambda f: not f.packages.registered,
        "nerfstudio does not know the methods of abcd_ns: it is not installed in this environment.",
        "In its checkout: pip install .",
    ),
    error(
        "no-ns-train",
        lambda f: not f.packages.has_ns_train,
        "There is no command ns-train beside this Python.",
        "Install nerfstudio into this environment, or activate the one that has it.",
    ),
    error(
        "self-check",
        lambda f: failed(f, "torch"),
        "{name}: {why}",
        "Delete {f.kernels.folder}, so that its library is compiled anew.",
    ),
    error(
        "self-check",
        lambda f: failed(f, "gsplat"),
        "{name}: {why}",
        "Train with --pipeline.model.rasterizer torch, or delete {f.kernels.gsplat}: it is built anew.",
    ),
    error(
        "gsplat-cannot-be-built",
        lambda f: needs_gsplat(f) and missing_tools(f),
        "gsplat's CUDA kernels are not built. To build them, the PATH lacks {missing}.",
        "Install the CUDA toolkit {f.hardware.torch_cuda} (nvcc), g++ and ninja. Or train slowly, with "
        "--pipeline.model.rasterizer torch",
    ),
    error(
        "gsplat-cannot-be-built",
        lambda f: needs_gsplat(f) and not missing_tools(f) and not right_nvcc(f),
        "gsplat's CUDA kernels are not built. nvcc is of CUDA {f.kernels.nvcc}, but torch is built for "
        "{f.hardware.torch_cuda} and refuses to compile with another.",
        "Put the nvcc of CUDA {f.hardware.torch_cuda} first on the PATH, or install torch for "
        "{f.kernels.nvcc}.",
    ),
    note(
        "gsplat-not-built",
        lambda f: needs_gsplat(f) and not missing_tools(f) and right_nvcc(f),
        "gsplat's CUDA kernels are not built. The first training or `abcd plan` compiles them, once: some 20 "
        "minutes of CPU time, spread over up to 10 processes.",
        "If that takes too much RAM, set MAX_JOBS=2 for it.",
    ),
    note(
        "no-gpu",
        lambda f: f.hardware and not f.hardware.gpu and not f.hardware.driver,
        "No CUDA device: training runs on the CPU. That is meant for pictures some 160 to 320 px wide.",
    ),
    warning(
        "torch-without-cuda",
        lambda f: hidden_gpu(f) and not f.hardware.torch_cuda,
        "There is an NVIDIA device (driver {f.hardware.driver}), but torch is built for the CPU only.",
        "Install torch and torchvision as built for CUDA.",
    ),
    warning(
        "cuda-unavailable",
        lambda f: hidden_gpu(f) and f.hardware.torch_cuda,
        "There is an NVIDIA device (driver {f.hardware.driver}), but torch, built for CUDA "
        "{f.hardware.torch_cuda}, cannot use it.",
        "Update the driver, or install torch for an older CUDA; look at CUDA_VISIBLE_DEVICES.",
    ),
    error(
        "read-only-folder",
        lambda f: f.hardware and not f.hardware.may_write,
        "You may not write into this folder, where ns-train makes `outputs`.",
        "Go to another folder, or give ns-train --output-dir FOLDER",
    ),
    warning(
        "little-disk",
        lambda f: f.hardware and little(f.hardware.disk_free_bytes, LITTLE_DISK),
        "Only {free} of disk are free here. A run's blocks take six times the size of the scene, and each "
        "checkpoint once that.",
        "Make room, or give ns-train --output-dir FOLDER on another disk.",
    ),
    warning(
        "little-ram",
        lambda f: f.hardware and little(f.hardware.ram_free_bytes, LITTLE_RAM),
        "Only {free} of RAM are free. By default photos, blocks and layers take up to 8 GiB of it, or 40% of "
        "all.",
        "Close other programs, or lower --pipeline.ram-budget-gb",
    ),
    warning(
        "untested-version",
        untested,
        "{name} is {version}; abcd_ns was tested with {tested} and relies on its insides.",
        "If something fails, try pip install {name}=={tested}",
    ),
    note(
        "viewer-hole",
        lambda f: numbers(f.packages.versions.get("viser") or "9") < VISER_MENDED,
        "viser {f.packages.versions[viser]} sends every file that you can read to anyone that reaches "
        "the viewer's port. nerfstudio listens on all networks, `ns-train abcd` on this machine alone.",
        "For other methods, and with ns-viewer on their runs: --viewer.websocket-host 127.0.0.1; from "
        "another machine use ssh -L 7007:127.0.0.1:7007 HOST",
    ),
    note(
        "library-not-compiled",
        lambda f: needs_library(f) and f.kernels.compiler,
        "The CPU rasterizer is not compiled yet. First use compiles it, in some 15 seconds.",
    ),
    warning(
        "no-compiler",
        lambda f: needs_library(f) and not f.kernels.compiler,
        "There is no C++ compiler for the CPU rasterizer. Training on a CPU works, some 20 times slower.",
        "Install one: sudo apt-get install g++",
    ),
    note(
        "no-lpips",
        lambda f: f.kernels and f.kernels.lpips_missing,
        "{f.kernels.lpips_missing}. Nothing is downloaded by default. Until then scores are PSNR and SSIM.",
    ),
)
