"""`abcd plan`: `forecast` reads photos and times a step, `command` loads that where options are right."""

from dataclasses import dataclass
from typing import Annotated

import tyro

from abcd_ns.arguments import Number


@dataclass(frozen=True)
class Wanted:
    """What a run is to be like."""

    blocks: Number = 0
    """Number of blocks. 0 takes as few as the device's budget permits."""
    device_budget_gb: Annotated[float, tyro.conf.arg(metavar="GiB")] = 0.0
    """Memory of the device that training may take.
    0 takes 90% of a GPU's free memory, or a quarter of the RAM on a CPU."""
    max_gaussians: Number = 0
    """Limit on Gaussians in the scene. 0 sets none; the forecast is five for each point."""
    steps: Number = 30_000
    """Steps of the run."""
    workers: Number = 1
    """Blocks trained at once, each by a process on its own GPU or on a part of the cores."""
