"""How many blocks a scene needs on this device."""

from dataclasses import dataclass

import psutil
import torch

from abcd_ns.engine.config import TrainingConfig
from abcd_ns.engine.memory import DeviceNeeds, fewest_blocks
from abcd_ns.engine.schedule import views_per_step
from abcd_ns.engine.splitting import FULL
from abcd_ns.errors import UserError

GB = 2**30
EXPECTED_GROWTH = 5
"""Gaussians at the end for each initial point, where no limit is set; for forecasts only."""
FREE_SHARE = 0.9
"""Of a GPU's free memory: the rest is for what the allocator cannot use."""
RAM_SHARE = 0.25
"""Of the machine's RAM, where the CPU is the device."""
LEAST_BLOCK = 1_000
"""A block with room for fewer Gaussians is not worth a visit."""


@dataclass(frozen=True)
class Room:
    """What a budget allows."""

    blocks: int
    """To begin with: as few as hold the initial Gaussians. Those that outgrow their room are cut in two."""
    limit: int
    """Gaussians in a block at most, where there are several."""
    sole: int
    """Gaussians at most in a block that is the whole scene."""
    budget: int
    """Bytes of the device that training may take."""
    gaussians: int
    """Expected in the whole scene at the end."""

    @property
    def blocks_at_the_end(self) -> int:
        """If as many Gaussians come as are expected."""
        return max(self.blocks, _fewest(self.gaussians, self.limit, self.sole))

    def in_words(self) -> str:
        """One line for the terminal."""
        blocks = "1 block" if self.blocks == 1 else f"{self.blocks} blocks"
        limit = self.sole if self.blocks == 1 else self.limit
        return (
            f"{self.budget / GB:.1f} GB of the device allow {limit:,} Gaussians in a block: {blocks} to "
            "begin with; a block that comes near that is cut in two."
        )


def _fewest(gaussians: int, limit: int, sole: int) -> int:
    """Blocks for so many Gaussians."""
    return 1 if gaussians <= FULL * sole else max(2, fewest_blocks(gaussians, limit, FULL))


def device_budget(wanted_gb: float, device: torch.device | str) -> int:
    """Bytes of the device that training may take: what is wanted, or with 0 what there is."""
    if wanted_gb > 0:
        return int(wanted_gb * GB)
    if torch.device(device).type == "cuda":
        return int(FREE_SHARE * torch.cuda.mem_get_info(device)[0])
    return int(RAM_SHARE * psutil.virtual_memory().total)


def check_room(budget: int, pixels: int, training: TrainingConfig) -> None:
    """Whether `budget` bytes allow any block at all for images of so many pixels.

    Raises:
        UserError: they do not.
    """
    needs = _needs(pixels, training, blocks=2)
    if needs.block_limit(budget) < LEAST_BLOCK:
        raise UserError(
            f"--pipeline.device-budget-gb {budget / GB:.2f} is too little for images of {pixels:,} px: give "
            f"{needs.bytes_for(LEAST_BLOCK) / GB:.2f} or more, one view in a step by --pipeline.training."
            "batch 1, or smaller images by --pipeline.datamanager.dataparser.downscale-factor."
        )


def find_room(
    budget: int, *, pixels: int, points: int, most: int | None = None, training: TrainingConfig
) -> Room:
    """The fewest blocks whose visits stay within `budget` bytes.

    Args:
        pixels: of the largest image.
        points: the scene begins with.
        most: limit on Gaussians in the whole scene; None for none.

    Raises:
        UserError: the budget has no room for any block worth a visit.
    """
    check_room(budget, pixels, training)
    # A single block has no neighbours and draws one view a step, so it may be larger.
    sole, limit = (_needs(pixels, training, blocks).block_limit(budget) for blocks in (1, 2))
    first = points if most is None else min(points, most)
    return Room(_fewest(first, limit, sole), limit, sole, budget, most or EXPECTED_GROWTH * points)


def _needs(pixels: int, training: TrainingConfig, blocks: int) -> DeviceNeeds:
    return DeviceNeeds(pixels, views_per_step(training.batch, blocks), training.sh_degree)
