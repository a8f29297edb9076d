"""All kernels that a primitive needs, and the process that builds them:
`python -m abcd_ns.engine.build_kernels 4 8 2dgs`."""

import sys

from abcd_ns.engine.kernels import Kernel
from abcd_ns.engine.kernels.build import compile_all
from abcd_ns.engine.kernels.photometric import PHOTOMETRIC_KERNELS
from abcd_ns.engine.render.cpu.chunk_kernels import chunk_kernels
from abcd_ns.engine.render.primitive import PRIMITIVES, PrimitiveName


def all_kernels(side: int, chunk: int, primitive: PrimitiveName = "3dgs") -> tuple[Kernel, ...]:
    """Those that every run with a primitive uses, the slowest to compile first.

    Args:
        side, chunk: of the torch rasterizer, see TorchRasterizer.
    """
    drawn = PRIMITIVES[primitive]
    return (*chunk_kernels(side, chunk, drawn), *PHOTOMETRIC_KERNELS, *drawn.kernels)


if __name__ == "__main__":
    compile_all(all_kernels(int(sys.argv[1]), int(sys.argv[2]), *sys.argv[3:]))
