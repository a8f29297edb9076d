"""How many Gaussians fit on the device: what a visit holds there, part by part.

A model to plan with, made of what must be held and rounded up; `abcd scale` measures.
"""

import math
from dataclasses import dataclass

from abcd_ns.engine.painter import LEAST_PASS
from abcd_ns.engine.visit import AT_HAND_BYTES, PARTS_BYTES

FLOAT = 4
"""Bytes."""
PROJECTED_FLOATS = 50
"""Of a Gaussian in one view: its splat (11 numbers), copies sorted by tile, the gradients of all these."""
PIXEL_FLOATS = 120
"""Of a pixel of a crop in training: picture, photo, F, B, and the windowed moments of SSIM with gradients."""


@dataclass(frozen=True)
class DeviceNeeds:
    """What training takes on the device, bytes.

    Args:
        pixels: of the largest image.
        batch: views in a step.
    """

    pixels: int
    batch: int
    sh_degree: int = 3

    @property
    def parameter_bytes(self) -> int:
        """Of one Gaussian's parameters: 59 floats with spherical harmonics of degree 3."""
        return FLOAT * (11 + 3 * (self.sh_degree + 1) ** 2)

    @property
    def gaussian_bytes(self) -> int:
        """Of one Gaussian in training: parameters, gradient, two moments; three of them once more while the
        block is refined; and what its views' drawings hold."""
        return 7 * self.parameter_bytes + self.batch * PROJECTED_FLOATS * FLOAT

    @property
    def fixed_bytes(self) -> int:
        """Whatever the block: layers at hand, layers while they are folded, the least pass of frozen
        Gaussians, and the step's crops."""
        frozen = LEAST_PASS * (self.parameter_bytes + PROJECTED_FLOATS * FLOAT)
        return AT_HAND_BYTES + PARTS_BYTES + frozen + self.batch * self.pixels * PIXEL_FLOATS * FLOAT

    def bytes_for(self, gaussians: int) -> int:
        """The peak of a visit to a block of so many Gaussians."""
        return self.fixed_bytes + gaussians * self.gaussian_bytes

    def block_limit(self, budget: int) -> int:
        """Gaussians that a block may have for its visits to stay within `budget` bytes; may be 0 or less."""
        return (budget - self.fixed_bytes) // self.gaussian_bytes


def fewest_blocks(gaussians: int, limit: int, full: float) -> int:
    """Equal blocks for so many Gaussians, none of them above the share `full` of `limit`."""
    return max(1, math.ceil(gaussians / max(full * limit, 1.0)))
