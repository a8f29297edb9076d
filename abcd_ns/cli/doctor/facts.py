"""All that `abcd doctor` knows of a machine."""

import dataclasses
from dataclasses import dataclass
from typing import Any

from abcd_ns import machine
from abcd_ns.cli.doctor.hardware import Hardware, look_at_hardware
from abcd_ns.cli.doctor.kernels import Kernels, look_at_kernels
from abcd_ns.cli.doctor.packages import STARTED, Packages, look_at_packages
from abcd_ns.progress_bar import ProgressBar


@dataclass(frozen=True)
class Facts:
    """The machine and the environment that this command runs in."""

    packages: Packages
    hardware: Hardware | None
    """None where torch does not start."""
    kernels: Kernels | None
    """None where torch or abcd_ns do not start, so that where there are kernels there is hardware."""


def gather() -> Facts:
    """Look at everything. Compiles nothing and writes nothing."""
    hardware = kernels = None
    with ProgressBar("Looking at this machine", len(STARTED) + 3) as bar:
        packages = look_at_packages(bar.advance)
        if "torch" not in packages.broken:
            hardware = look_at_hardware()
        bar.advance()
        if hardware is not None and "abcd_ns.nerfstudio.method_configs" not in packages.broken:
            kernels = look_at_kernels(on_gpu=hardware.gpu is not None)
        bar.advance()
    return Facts(packages, hardware, kernels)


def without_home(value: Any) -> Any:
    """`value`, a record or a text, with ~ for the user's home folder in all its texts: fit to be shown."""
    if isinstance(value, str):
        return machine.without_home(value)
    if isinstance(value, dict):
        return {without_home(key): without_home(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(without_home(inner) for inner in value)
    if dataclasses.is_dataclass(value):
        names = [field.name for field in dataclasses.fields(value)]
        return dataclasses.replace(value, **{name: without_home(getattr(value, name)) for name in names})
    return value
