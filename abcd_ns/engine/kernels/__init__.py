"""Inner loops: plain torch functions that also run as machine code, built once per machine."""

from abcd_ns.engine.kernels.kernel import Kernel, find_compiler, kernels_folder

__all__ = ["Kernel", "find_compiler", "kernels_folder"]
