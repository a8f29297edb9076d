"""How many Gaussians fit on the device: a model to plan with, and a look before memory is taken.

The model adds up what a visit must hold, part by part, and rounds up. `abcd scale` measures what a CPU run
takes; the numbers below have not been compared with a GPU's.
"""

import math
from dataclasses import dataclass

import psutil
import torch

from abcd_ns.engine.config import TrainingConfig
from abcd_ns.engine.painter import LEAST_PASS
from abcd_ns.engine.schedule import views_per_step, views_per_warm_up_step
from abcd_ns.engine.visit import AT_HAND_BYTES, PARTS_BYTES
from abcd_ns.errors import UserError

FLOAT = 4
"""Bytes."""
PROJECTED_FLOATS = 50
"""Of a Gaussian in one view: its splat (11 numbers), copies sorted by tile, the gradients of all these."""
PIXEL_FLOATS = 120
"""Of a pixel of a crop in training: picture, photo, F, B, and the windowed moments of SSIM with gradients."""
LIVE_COPIES = 5
"""Of each value while a block is live: the parameter, its gradient, two moments, and the block at rest."""


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


def scaffold_size(config: TrainingConfig, block: int, pixels: int) -> int:
    """Gaussians of the warm-up: where not given, as many as take no more than a visit to a block does.

    Args:
        block: Gaussians of the largest block, one of several.
        pixels: of the largest image.
    """
    batches = views_per_step(config.batch, blocks=2), views_per_warm_up_step(config.batch)
    visit, warm_up = (DeviceNeeds(pixels, batch, config.sh_degree) for batch in batches)
    return config.scaffold_gaussians or warm_up.block_limit(visit.bytes_for(block))


def fewest_blocks(gaussians: int, limit: int, full: float) -> int:
    """Equal blocks for so many Gaussians, none of them above the share `full` of `limit`."""
    return max(1, math.ceil(gaussians / max(full * limit, 1.0)))


class OutOfRoomError(UserError):
    """A block is too large for the memory that is free."""


def bytes_for(gaussians: int, sh_degree: int) -> int:
    """What a live block of so many Gaussians takes, pictures not counted."""
    return gaussians * (11 + 3 * (sh_degree + 1) ** 2) * FLOAT * LIVE_COPIES


def drawing_bytes(sh_degree: int) -> int:
    """What a Gaussian takes while it is drawn without gradients: its parameters, once more as the rasterizer
    wants them, and what one view sees of it."""
    return FLOAT * (2 * (11 + 3 * (sh_degree + 1) ** 2) + PROJECTED_FLOATS)


def free_bytes(device: torch.device) -> int:
    """What `device` has left, memory that torch holds in reserve included."""
    if device.type != "cuda":
        return psutil.virtual_memory().available
    reserve = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    return torch.cuda.mem_get_info(device)[0] + reserve


def check_room(gaussians: int, sh_degree: int, device: torch.device) -> None:
    """Refuse a block that cannot fit.

    Raises:
        OutOfRoomError: the memory that is free does not suffice; says what would.
    """
    needed, free = bytes_for(gaussians, sh_degree), free_bytes(device)
    if needed > free:
        raise OutOfRoomError(
            f"A block of {gaussians:,} Gaussians takes {needed / 2**30:.1f} GiB, but {device} has "
            f"{free / 2**30:.1f} GiB left; set --pipeline.training.density.max-gaussians, or more "
            "--pipeline.blocks."
        )
