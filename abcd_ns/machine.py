"""On what runs were made: hardware and versions.

torch is imported on use: `abcd doctor` must say what is wrong where it does not start.
"""

import ctypes
import os
import platform
import re
import signal
import subprocess
import sys
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import psutil

import abcd_ns

PR_SET_PDEATHSIG = 1  # of Linux' prctl


@dataclass(frozen=True)
class Machine:
    """What decides how fast a run is."""

    cpu: str
    cores: int  # that this process may use
    torch_threads: int
    ram_bytes: int
    gpu: str | None
    os: str


@dataclass(frozen=True)
class Versions:
    """What decides what a run computes."""

    python: str
    torch: str
    nerfstudio: str | None
    gsplat: str | None
    abcd_ns: str
    commit: str | None
    """Of the abcd_ns checkout, with "+changes" where files differ from it; None outside a checkout."""


def end_with_parent() -> None:
    """On Linux, have this process killed when its parent ends, however that ends."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


def usable_cores() -> int:
    """Those that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def threads_wanted() -> int:
    """Threads to compute on: OMP_NUM_THREADS where it is set, else one for each usable core."""
    asked = os.environ.get("OMP_NUM_THREADS", "")
    return int(asked) if asked.isdigit() and int(asked) > 0 else usable_cores()


def describe_machine() -> Machine:
    """This machine."""
    import torch

    return Machine(
        cpu=proc_value("cpuinfo", "model name") or platform.processor() or platform.machine(),
        cores=usable_cores(),
        torch_threads=threads_wanted(),
        ram_bytes=psutil.virtual_memory().total,
        gpu=torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        os=f"{platform.system()} {platform.machine()}",
    )


def describe_versions() -> Versions:
    """The versions in this environment."""
    import torch

    return Versions(
        python=platform.python_version(),
        torch=torch.__version__,
        nerfstudio=package_version("nerfstudio"),
        gsplat=package_version("gsplat"),
        abcd_ns=abcd_ns.__version__,
        commit=own_commit(),
    )


def without_home(text: str) -> str:
    """The text with ~ in place of the home folder, since results are published."""
    home = str(Path.home())
    return text if home == "/" else re.sub(rf"(?<![\w.-]){re.escape(home)}(?![\w.-])", "~", text)


def peak_rss_bytes() -> int:
    """The most RAM that this process has held so far."""
    # Not getrusage: on Linux its ru_maxrss starts from the parent's peak, across fork and exec.
    if (in_kib := proc_value("self/status", "VmHWM")) is not None:
        return int(in_kib.removesuffix("kB")) * 1024
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024  # bytes on macOS, KiB elsewhere


def peak_device_bytes() -> tuple[int | None, int | None]:
    """The most GPU memory that torch has held in tensors so far, and the most that it has taken for them from
    the device; None without a CUDA device."""
    import torch

    if not torch.cuda.is_available():
        return None, None
    return torch.cuda.max_memory_allocated(), torch.cuda.max_memory_reserved()


def disk_bytes(folder: Path) -> int:
    """What the files under `folder` take on disk; 0 where there is no such folder."""
    # st_blocks counts 512 bytes each, whatever the block size; sparse files take less than st_size.
    return sum(path.stat().st_blocks * 512 for path in folder.rglob("*") if path.is_file())


def proc_value(file: str, *names: str) -> str | None:
    """The first value of one of these names in a file of Linux' /proc; None on other systems."""
    path = Path("/proc", file)
    lines = path.read_text().splitlines() if path.exists() else []
    return next((line.partition(":")[2].strip() for line in lines if line.startswith(names)), None)


def package_version(package: str) -> str | None:
    """The installed version of a distribution, or None."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def own_commit() -> str | None:
    """The commit of this checkout of abcd_ns, with "+changes" where files differ from it."""
    checkout = Path(abcd_ns.__file__).resolve().parent.parent
    if not (checkout / ".git").exists():
        return None
    git = ("git", "-C", str(checkout))
    head = output_of(*git, "rev-parse", "HEAD")
    if head is None:
        return None
    return head + ("+changes" if output_of(*git, "status", "--porcelain") else "")


def output_of(*command: str) -> str | None:
    """What a short command prints, without white space around; None where it fails or is not here."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=30)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()
