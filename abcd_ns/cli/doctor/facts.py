"""All that `abcd doctor` knows of a machine."""

from dataclasses import dataclass

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
    with ProgressBar("Looking at this machine", len(STARTED) + 1) as bar:
        packages = look_at_packages(bar.advance)
        if "torch" not in packages.broken:
            hardware = look_at_hardware()
        if hardware is not None and "abcd_ns.nerfstudio.method_configs" not in packages.broken:
            kernels = look_at_kernels(on_gpu=hardware.gpu is not None)
    return Facts(packages, hardware, kernels)
