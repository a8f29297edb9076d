"""What is hot on a CPU, in C++ (`cpp/`): compiled once a machine, loaded by ctypes. Torch's the reference."""

from abcd_ns.engine.kernels.native import find_compiler, kernels_folder, library, share_cores

__all__ = ["find_compiler", "kernels_folder", "library", "share_cores"]
