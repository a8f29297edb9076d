"""Whether so many Gaussians fit, before memory for them is taken."""

import psutil
import torch

from abcd_ns.errors import UserError

COPIES = 5
"""Of each value while a block is live: the parameter, its gradient, two moments, and the block at rest."""
BYTES = 4


class OutOfRoomError(UserError):
    """A block is too large for the memory that is free."""


def bytes_for(gaussians: int, sh_degree: int) -> int:
    """What a live block of so many Gaussians takes, pictures not counted."""
    return gaussians * (11 + 3 * (sh_degree + 1) ** 2) * BYTES * COPIES


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
