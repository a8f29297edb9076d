"""The machine: what there is, and how much of it is free."""

import os
import platform
import shutil
import warnings
from dataclasses import dataclass
from pathlib import Path

import psutil

from abcd_ns.machine import describe_machine, output_of

OUTPUTS = Path("outputs")
"""Where `ns-train` writes by default."""


@dataclass(frozen=True)
class Gpu:
    """The CUDA device that training takes."""

    name: str
    memory_bytes: int
    capability: str
    """As "9.0"."""


@dataclass(frozen=True)
class Hardware:
    """What training can use."""

    os: str
    cpu: str
    cores: int
    """That this process may use."""
    ram_bytes: int
    ram_free_bytes: int
    disk_free_bytes: int
    """Where `ns-train`, called here, would write."""
    may_write: bool
    """Whether this user may write there."""
    gpu: Gpu | None
    """As torch sees it."""
    gpus: int
    """How many there are."""
    torch_cuda: str | None
    """The CUDA version that torch was built for, if any."""
    driver: str | None
    """Of an NVIDIA device, whether torch sees it or not."""


def look_at_hardware() -> Hardware:
    """Needs a torch that starts."""
    import torch

    machine, memory = describe_machine(), psutil.virtual_memory()
    place = OUTPUTS if OUTPUTS.is_dir() else Path()
    return Hardware(
        os=f"{platform.system()} {platform.release()} {platform.machine()}",
        cpu=machine.cpu,
        cores=machine.cores,
        ram_bytes=memory.total,
        ram_free_bytes=memory.available,
        disk_free_bytes=shutil.disk_usage(place).free,
        may_write=os.access(place, os.W_OK),
        gpu=_gpu(),
        gpus=torch.cuda.device_count(),
        torch_cuda=torch.version.cuda,
        driver=_driver(),
    )


def _gpu() -> Gpu | None:
    import torch

    with warnings.catch_warnings():
        # An old driver is a finding of ours, and needs no warning of torch's.
        warnings.simplefilter("ignore")
        if not torch.cuda.is_available():
            return None
    found = torch.cuda.get_device_properties(torch.cuda.current_device())
    return Gpu(found.name, found.total_memory, f"{found.major}.{found.minor}")


def _driver() -> str | None:
    """The NVIDIA driver's version, of the first device."""
    said = output_of("nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader")
    return said.split()[0] if said else None
