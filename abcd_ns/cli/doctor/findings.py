"""What is wrong or missing on a machine, and what to do about it."""

import re
from collections.abc import Iterator

from abcd_ns.cli.doctor.facts import Facts
from abcd_ns.cli.doctor.packages import EXPORT
from abcd_ns.cli.findings import Finding, error, note, warning
from abcd_ns.units import GIB, bytes_in_words

TESTED = {"nerfstudio": "1.1.5", "gsplat": "1.4.0"}
"""Versions whose insides are relied on."""
VISER_MENDED = (1, 0, 25)
"""The first version of viser that serves its own files only."""
LITTLE_RAM, LITTLE_DISK = 4 * GIB, 6 * GIB
"""Free bytes below which runs of usual size end early."""
SYSTEM_LIBRARIES = "sudo apt-get install libgl1 libegl1 libgomp1 libusb-1.0-0 libx11-6"


def missing_packages(facts: Facts) -> Iterator[Finding]:
    """Packages that are not installed."""
    missing = [name for name, version in facts.packages.versions.items() if version is None]
    if missing:
        yield error(
            "missing-packages",
            f"Not installed: {', '.join(missing)}.",
            "In the checkout of abcd_ns: pip install .",
        )


def broken_packages(facts: Facts) -> Iterator[Finding]:
    """Packages that do not start."""
    for module, why in facts.packages.broken.items():
        if module == EXPORT:
            yield warning(
                "broken-export",
                f"ns-export and abcd mesh cannot start, as {module} does not: {why}",
                f"On Debian and Ubuntu: {SYSTEM_LIBRARIES}",
            )
        elif "torchvision::nms" in why:
            yield error(
                "broken-package",
                f"torch and torchvision do not belong together: {why}",
                "Install both from the same place, of versions that match.",
            )
        else:
            yield error(
                "broken-package",
                f"{module} does not start: {why}",
                f"Install it again; if a lib*.so is missing, {SYSTEM_LIBRARIES}",
            )


def not_registered(facts: Facts) -> Iterator[Finding]:
    """An environment in which `ns-train abcd` is unknown."""
    if not facts.packages.registered:
        yield error(
            "not-registered",
            "nerfstudio does not know the methods of abcd_ns: it is not installed in this environment.",
            "In its checkout: pip install .",
        )
    if not facts.packages.has_ns_train:
        yield error(
            "no-ns-train",
            "There is no command ns-train beside this Python.",
            "Install nerfstudio into this environment, or activate the one that has it.",
        )


def untested_versions(facts: Facts) -> Iterator[Finding]:
    """Versions that abcd_ns was not tested with."""
    for name, tested in TESTED.items():
        version = facts.packages.versions.get(name)
        if version is not None and version.split("+")[0] != tested:
            yield warning(
                "untested-version",
                f"{name} is {version}; abcd_ns was tested with {tested} and relies on its insides.",
                f"If something fails, try pip install {name}=={tested}",
            )


def viewer(facts: Facts) -> Iterator[Finding]:
    """viser's hole."""
    version = facts.packages.versions.get("viser")
    if version is not None and _numbers(version) < VISER_MENDED:
        yield note(
            "viewer-hole",
            f"viser {version} sends every file that you can read to whoever reaches the viewer's port, and "
            "nerfstudio listens on all networks unless told. `ns-train abcd` listens on this machine alone.",
            "For other methods, and with ns-viewer on their runs: --viewer.websocket-host 127.0.0.1; from "
            "another machine use ssh -L 7007:127.0.0.1:7007 HOST",
        )


def disk(facts: Facts) -> Iterator[Finding]:
    """A folder that cannot take a run's files."""
    if facts.hardware is None:
        return
    if not facts.hardware.may_write:
        yield error(
            "read-only-folder",
            "You may not write into this folder, where ns-train makes `outputs`.",
            "Go to another folder, or give ns-train --output-dir FOLDER",
        )
    if facts.hardware.disk_free_bytes < LITTLE_DISK:
        yield warning(
            "little-disk",
            f"Only {bytes_in_words(facts.hardware.disk_free_bytes)} of disk are free here. A run's blocks "
            "take six times the size of the scene, and each checkpoint once that.",
            "Make room, or give ns-train --output-dir FOLDER on another disk.",
        )


def ram(facts: Facts) -> Iterator[Finding]:
    """Little RAM."""
    free = facts.hardware.ram_free_bytes if facts.hardware else LITTLE_RAM
    if free < LITTLE_RAM:
        yield warning(
            "little-ram",
            f"Only {bytes_in_words(free)} of RAM are free. By default photos, blocks and layers take up "
            "to 8 GiB of it, or 40% of all.",
            "Close other programs, or lower --pipeline.ram-budget-gb",
        )


def gpu(facts: Facts) -> Iterator[Finding]:
    """No GPU, or one that torch does not see."""
    hardware = facts.hardware
    if hardware is None or hardware.gpu is not None:
        return
    if hardware.driver is None:
        yield note(
            "no-gpu",
            "No CUDA device: training runs on the CPU with the torch rasterizer. That is meant for small "
            "pictures, some 160 to 320 px wide.",
        )
    elif hardware.torch_cuda is None:
        yield warning(
            "torch-without-cuda",
            f"There is an NVIDIA device (driver {hardware.driver}), but torch is built for the CPU only.",
            "Install torch and torchvision as built for CUDA.",
        )
    else:
        yield warning(
            "cuda-unavailable",
            f"There is an NVIDIA device (driver {hardware.driver}), but torch, built for CUDA "
            f"{hardware.torch_cuda}, does not get at it.",
            "Update the driver, or install torch for an older CUDA; look at CUDA_VISIBLE_DEVICES.",
        )


def cpu_library(facts: Facts) -> Iterator[Finding]:
    """A CPU rasterizer that has to be compiled, or cannot be."""
    kernels, hardware = facts.kernels, facts.hardware
    if kernels is None or hardware.gpu is not None or kernels.built:
        return
    if kernels.compiler:
        yield note(
            "library-not-compiled",
            "The CPU rasterizer is not compiled yet; first use does it, in some 15 seconds.",
        )
    else:
        yield warning(
            "no-compiler",
            "There is no C++ compiler for the CPU rasterizer: training on a CPU works, some 20 times slower.",
            "Install one: sudo apt-get install g++",
        )


def gsplat_extension(facts: Facts) -> Iterator[Finding]:
    """gsplat's CUDA kernels: whether they are there, or can be compiled."""
    kernels, hardware = facts.kernels, facts.hardware
    if kernels is None or hardware.gpu is None or kernels.gsplat is not None:
        return
    tools = {"nvcc": kernels.nvcc, "ninja": kernels.ninja, "a C++ compiler": kernels.compiler}
    missing = [name for name, there in tools.items() if not there]
    if missing:
        yield error(
            "gsplat-cannot-be-built",
            f"gsplat's CUDA kernels are neither built nor can be: not on the PATH are {', '.join(missing)}.",
            f"Install the CUDA toolkit {hardware.torch_cuda or ''} (nvcc), g++ and ninja; or train slowly, "
            "with --pipeline.model.rasterizer torch",
        )
    elif _numbers(kernels.nvcc)[:1] != _numbers(hardware.torch_cuda or "")[:1]:
        yield error(
            "gsplat-cannot-be-built",
            f"gsplat's CUDA kernels are not built, and nvcc is of CUDA {kernels.nvcc}, but torch is built "
            f"for {hardware.torch_cuda} and refuses to compile with another.",
            f"Put the nvcc of CUDA {hardware.torch_cuda} first on the PATH, or install torch for "
            f"{kernels.nvcc}.",
        )
    else:
        yield note(
            "gsplat-not-built",
            "gsplat's CUDA kernels are not built; the first training or `abcd plan` compiles them, once: "
            "some 20 minutes of CPU time, spread over up to 10 processes.",
            "If that takes too much RAM, set MAX_JOBS=2 for it.",
        )


def self_check(facts: Facts) -> Iterator[Finding]:
    """Rasterizers that compute something else than the reference."""
    for name, why in facts.kernels.failed.items() if facts.kernels else ():
        if name.startswith("torch"):
            fix = f"Delete {facts.kernels.folder}, so that its library is compiled anew."
        else:
            fix = f"Train with --pipeline.model.rasterizer torch; or delete {facts.kernels.gsplat}: it is "
            fix += "built anew when training begins."
        yield error("self-check", f"{name}: {why}", fix)


def lpips(facts: Facts) -> Iterator[Finding]:
    """Weights that are not there."""
    if facts.kernels is not None and facts.kernels.lpips_missing is not None:
        yield note(
            "no-lpips",
            f"{facts.kernels.lpips_missing}. Nothing is downloaded unasked; until then scores are PSNR and "
            "SSIM only.",
        )


ALL = (missing_packages, broken_packages, not_registered, self_check, gsplat_extension, gpu, disk, ram)
ALL += (untested_versions, viewer, cpu_library, lpips)


def _numbers(version: str) -> tuple[int, ...]:
    """ "1.0.25rc1" as (1, 0, 25, 1)."""
    return tuple(map(int, re.findall(r"\d+", version.split("+")[0])))
