"""What is wrong or missing on a machine, and what to do about it."""

from collections.abc import Iterator

from abcd_ns.cli.doctor.facts import COMPILER, EXPORT, Facts
from abcd_ns.cli.findings import Finding, error, note, warning
from abcd_ns.units import GIB, bytes_in_words

TESTED = {"nerfstudio": "1.1.5", "gsplat": "1.4.0"}
"""Versions whose insides are relied on."""
LITTLE_RAM, LITTLE_DISK = 4 * GIB, 6 * GIB
"""Free bytes below which runs of usual size end early."""
SYSTEM_LIBRARIES = "sudo apt-get install libgl1 libegl1 libgomp1 libusb-1.0-0 libx11-6"
NMS = "torchvision::nms"
"""In the error of a torchvision that was built for another torch."""


def findings_of(f: Facts) -> Iterator[Finding]:
    """All that is wrong."""
    yield from _of_packages(f)
    yield from _of_versions(f)
    yield from _of_the_machine(f)
    if f.folder is not None:
        yield from _of_kernels(f)


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


def _of_versions(f: Facts) -> Iterator[Finding]:
    for name, tested in TESTED.items():
        version = f.versions.get(name)
        if version is not None and version.split("+")[0] != tested:
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


def _unbuilt(f: Facts) -> Iterator[Finding]:
    """Whether gsplat's kernels, which are not there, can be built."""
    none, nvcc = "are not built.", f.build_tools["nvcc"]
    if missing := ", ".join(name for name, there in f.build_tools.items() if not there):
        yield error(
            "gsplat-cannot-be-built",
            f"gsplat's CUDA kernels {none} To build them, the PATH lacks {missing}.",
            f"Install the CUDA toolkit {f.torch_cuda} (nvcc), g++ and ninja. Or train slowly, with "
            "--pipeline.model.rasterizer torch",
        )
    elif nvcc.split(".")[0] != (f.torch_cuda or "").split(".")[0]:
        yield error(
            "gsplat-cannot-be-built",
            f"gsplat's CUDA kernels {none} nvcc is of CUDA {nvcc}, but torch is built for {f.torch_cuda} "
            "and refuses to compile with another.",
            f"Put the nvcc of CUDA {f.torch_cuda} first on the PATH, or install torch for {nvcc}.",
        )
    else:
        yield note(
            "gsplat-not-built",
            f"gsplat's CUDA kernels {none} The first training or `abcd plan` compiles them, once: some 20 "
            "minutes of CPU time, spread over up to 10 processes.",
            "If that takes too much RAM, set MAX_JOBS=2 for it.",
        )


def _of_kernels(f: Facts) -> Iterator[Finding]:
    if f.gpu and f.gsplat is None:
        yield from _unbuilt(f)
    if not f.gpu and not f.built and not f.build_tools[COMPILER]:
        what = "There is no C++ compiler for the CPU rasterizer. Training works, some 20 times slower."
        yield warning("no-compiler", what, "Install one: sudo apt-get install g++")
    if f.failed:
        fix = f"Delete {f.folder}, so that its library is compiled anew."
        yield error("self-check", f"The CPU rasterizer: {f.failed}", fix)
    if f.lpips_missing:
        what = f"{f.lpips_missing}. Nothing is downloaded by default. Until then scores are PSNR and SSIM."
        yield note("no-lpips", what)
