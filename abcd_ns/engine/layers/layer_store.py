"""The layers of a visit, kept where there is room for them: on the device, then in RAM.

They are rounded as soon as they are drawn, so that no result depends on where they lie.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.layers.layer_renderer import FrozenLayers
from abcd_ns.engine.render.projection import Splats
from abcd_ns.engine.types import Layer

LAYER_BYTES = 1 << 30
"""Of a visit's layers on the device, where nobody says how much there is."""
LARGEST_HALF = torch.finfo(torch.float16).max


@dataclass(frozen=True)
class Kept:
    """What is kept of one view."""

    layers: Float[Tensor, "k h w c"]
    """F and B, rounded: premultiplied colour, then transmittance. Or what else is kept by pixel."""
    interleaved: Splats | None = None
    """Frozen Gaussians inside the window."""

    @property
    def sizes(self) -> tuple[int, ...]:
        """Bytes of each of its tensors."""
        return (self.layers.nbytes, *(() if self.interleaved is None else (self.interleaved.planes.nbytes,)))

    @property
    def nbytes(self) -> int:
        return sum(self.sizes)

    def moved(self, move: Callable[[Tensor], Tensor]) -> "Kept":
        return Kept(move(self.layers), self.interleaved and Splats(move(self.interleaved.planes)))


def packed(parts: FrozenLayers) -> Float[Tensor, "2 h w 4"]:
    """F and B in one tensor, not yet rounded."""
    height, width, _ = parts.front.color.shape
    layers = parts.front.color.new_empty((2, height, width, 4))
    for into, one in zip(layers, (parts.front, parts.back), strict=True):
        into[..., :3], into[..., 3] = one.color, one.transmittance
    return layers


def unpacked(layers: Float[Tensor, "2 h w 4"]) -> FrozenLayers:
    """The inverse of `packed`; shares memory."""
    front, back = (Layer(one[..., :3], one[..., 3]) for one in layers)
    return FrozenLayers(front, back)


def rounded(layers: Float[Tensor, "k h w c"]) -> Float[Tensor, "k h w c"]:
    """Half floats of float32, within their range; float64 as it is."""
    if layers.dtype == torch.float64:
        return layers
    return layers.half().clamp_(-LARGEST_HALF, LARGEST_HALF)


class LayerStore:
    """What a visit keeps, by view, under limits of bytes. What has no room is not kept.

    Args:
        device_bytes: limit on the device, where layers are used.
        ram_bytes: limit in RAM, for what has no room on the device; unused where the device is the CPU.
    """

    def __init__(self, device: torch.device, device_bytes: int, ram_bytes: int = 0) -> None:
        self._device = device
        self.free = device_bytes
        """Bytes that are left on the device."""
        self._ram_room = 0 if device.type == "cpu" else ram_bytes
        self._kept: dict[int, Kept] = {}

    @property
    def nbytes(self) -> int:
        """Of all that is kept, wherever it is."""
        return sum(kept.nbytes for kept in self._kept.values())

    def put(self, view: int, kept: Kept) -> None:
        """Keep what was drawn for a view, which has nothing here yet, if there is room."""
        if kept.nbytes <= self.free:
            self.free -= kept.nbytes
        elif (needed := self._in_ram(kept)) <= self._ram_room:
            self._ram_room -= needed
            kept = kept.moved(_to_ram)
        else:
            return
        self._kept[view] = kept

    def _in_ram(self, kept: Kept) -> int:
        """Bytes that it takes there: torch pins memory in powers of two, and gives none of it back."""
        if self._device.type != "cuda":
            return kept.nbytes
        return sum(1 << (size - 1).bit_length() for size in kept.sizes if size)

    def get(self, view: int) -> Kept | None:
        """What is kept of a view, on the device."""
        found = self._kept.get(view)
        return found and found.moved(lambda tensor: tensor.to(self._device, non_blocking=True))


def _to_ram(tensor: Tensor) -> Tensor:
    """A copy in RAM; of a CUDA tensor in pinned RAM, without waiting: what reads it is queued behind it."""
    copy = torch.empty(tensor.shape, dtype=tensor.dtype, pin_memory=tensor.is_cuda)
    return copy.copy_(tensor, non_blocking=tensor.is_cuda)
