"""The chunk kernels of one size, and the choice between eager and built ones."""

import functools
from collections.abc import Callable
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.kernels import Kernel
from abcd_ns.engine.kernels.build import build_kernels
from abcd_ns.engine.kernels.photometric import PHOTOMETRIC_KERNELS
from abcd_ns.engine.render import splat_kernels, surfel_kernels
from abcd_ns.engine.render.cpu import splat_fragments, surfel_fragments
from abcd_ns.engine.render.cpu.splat_fragments import SplatFragments
from abcd_ns.engine.render.cpu.surfel_fragments import SurfelFragments
from abcd_ns.engine.render.cpu.torch_kernels import (
    STATE_PLANES,
    Fragments,
    backward_chunk,
    forward_chunk,
    weigh_chunk,
)
from abcd_ns.engine.render.primitive import SPLATS, Primitive

CompilePolicy = Literal["auto", "never"]


FRAGMENTS: dict[str, Fragments] = {"3dgs": SplatFragments(), "2dgs": SurfelFragments()}
"""By primitive."""
DEPENDS = {
    "3dgs": (splat_kernels.__file__, splat_fragments.__file__),
    "2dgs": (splat_kernels.__file__, surfel_kernels.__file__, surfel_fragments.__file__),
}
"""Source files."""


@functools.cache
def chunk_kernels(side: int, chunk: int, primitive: Primitive = SPLATS) -> tuple[Kernel, Kernel, Kernel]:
    """`forward_chunk`, `backward_chunk`, `weigh_chunk` for tiles of `side` px, `chunk` Gaussians a call."""
    pixels, fragments = side * side, FRAGMENTS[primitive.name]
    state = f"{STATE_PLANES} {pixels} a"
    given = (f"{fragments.opacity + 4} {chunk} a", "2 a", state)
    seen = (f"{fragments.opacity + 1} {chunk} a", "2 a", f"1 {pixels} a")

    def kernel(name: str, function: Callable[..., tuple[Tensor, ...]], shapes: tuple[str, ...]) -> Kernel:
        bound = functools.partial(function, fragments, side)
        return Kernel(f"{primitive.prefix}{name}-{side}-{chunk}", bound, shapes, DEPENDS[primitive.name])

    return (
        kernel("forward", forward_chunk, given),
        kernel("backward", backward_chunk, (*given, state)),
        kernel("weigh", weigh_chunk, seen),
    )


class ChunkKernels:
    """The chunk kernels of a rasterizer.

    Args:
        policy: "auto" takes built kernels where they are found and builds them when `warm_up` is called;
            "never" is eager.
    """

    def __init__(self, policy: CompilePolicy, side: int, chunk: int, primitive: Primitive = SPLATS) -> None:
        self._policy, self._size, self._primitive = policy, (side, chunk), primitive
        self._forward, self._backward, self._weigh = chunk_kernels(side, chunk, primitive)
        self.fragments = FRAGMENTS[primitive.name]
        self.built = policy != "never" and all(kernel.is_built for kernel in self._all)
        """Whether float32 on the CPU runs fast."""

    def warm_up(self) -> None:
        """Build the kernels, a few minutes once per machine, unless the policy is "never"."""
        needed = (*self._all, *PHOTOMETRIC_KERNELS)  # of the loss, which every training has
        if self._policy != "never" and not all(kernel.is_built for kernel in needed):
            build_kernels(needed, *self._size, self._primitive.name)
            self.built = all(kernel.is_built for kernel in self._all)

    @property
    def _all(self) -> tuple[Kernel, ...]:
        return (*self._primitive.kernels, self._forward, self._backward, self._weigh)

    def forward(
        self,
        params: Float[Tensor, "c k a"],
        origins: Float[Tensor, "2 a"],
        state: Float[Tensor, "s p a"],
    ) -> Float[Tensor, "s p a"]:
        """See torch_kernels.forward_chunk."""
        wide = _two_wide(params, origins, state)
        return self._forward(*wide, built=self.built)[0][..., : params.shape[-1]]

    def backward(
        self,
        params: Float[Tensor, "c k a"],
        origins: Float[Tensor, "2 a"],
        state: Float[Tensor, "s p a"],
        upstream: Float[Tensor, "s p a"],
    ) -> Float[Tensor, "g k a"]:
        """See torch_kernels.backward_chunk."""
        wide = _two_wide(params, origins, state, upstream)
        return self._backward(*wide, built=self.built)[0][..., : params.shape[-1]]

    def weigh(
        self,
        params: Float[Tensor, "c k a"],
        origins: Float[Tensor, "2 a"],
        state: Float[Tensor, "1 p a"],
    ) -> tuple[Float[Tensor, "1 p a"], Float[Tensor, "k a"]]:
        """See torch_kernels.weigh_chunk."""
        found = self._weigh(*_two_wide(params, origins, state), built=self.built)
        state, weights = (plane[..., : params.shape[-1]] for plane in found)
        return state, weights


def _two_wide(*tensors: Tensor) -> tuple[Tensor, ...]:
    """Built kernels take two tiles or more: a single one is drawn twice."""
    if tensors[0].shape[-1] != 1:
        return tensors
    return tuple(torch.cat((tensor, tensor), dim=-1) for tensor in tensors)
