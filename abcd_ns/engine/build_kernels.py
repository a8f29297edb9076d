"""All kernels there are, and the process that builds them: `python -m abcd_ns.engine.build_kernels 4 8`."""

import sys

from abcd_ns.engine.kernels import Kernel
from abcd_ns.engine.kernels.build import compile_all
from abcd_ns.engine.kernels.photometric import PHOTOMETRIC_KERNELS
from abcd_ns.engine.render.cpu.chunk_kernels import chunk_kernels
from abcd_ns.engine.render.splat_kernels import SPLAT_KERNELS


def all_kernels(side: int, chunk: int) -> tuple[Kernel, ...]:
    """Those that every run uses, the slowest to compile first.

    Args:
        side, chunk: of the torch rasterizer, see TorchRasterizer.
    """
    return (*chunk_kernels(side, chunk), *PHOTOMETRIC_KERNELS, *SPLAT_KERNELS)


if __name__ == "__main__":
    compile_all(all_kernels(int(sys.argv[1]), int(sys.argv[2])))
