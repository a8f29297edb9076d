"""The options of a run, beside those of training itself."""

import math
from dataclasses import dataclass, field
from typing import Literal

from abcd_ns.engine.space.partition import MAX_BLOCKS
from abcd_ns.engine.train.config import TrainingConfig, check_not_below_0
from abcd_ns.errors import UserError

NOT_BELOW_0 = ("blocks", "near_plane", "device_budget_gb", "gaussian_bytes", "ram_budget_gb", "workers")


@dataclass
class RunOptions:
    """How space is cut, how its blocks are trained, and on which memory and workers."""

    training: TrainingConfig = field(default_factory=TrainingConfig)
    """How blocks are trained. docs/reference.md has more options, for files and this command line."""
    blocks: int = 0
    """Number of blocks. 0 takes as few as the device's budget allows, and splits those that outgrow it.
    A number forces that many blocks; the memory budget is then not enforced."""
    device_budget_gb: float = 0.0
    """Device memory for training, GiB. 0 takes 90% of a GPU's free memory, or a quarter of the RAM.
    Of a GPU's, an eighth is for layers and one for photos."""
    gaussian_bytes: int = 0
    """Device memory for a block's Gaussians and all that training holds for each, bytes, instead of
    `device_budget_gb`. Pictures and layers come on top. For comparisons within a budget."""
    partition: Literal["kd", "grid"] = "kd"
    """kd: cells with equally many points. grid: equal cells, as the paper has, at least `blocks` of them."""
    near_plane: float = 0.0
    """Gaussians closer to a camera than this, along its axis, are not drawn; world units. 0 takes half
    the nearest distance at which a photo shows a point."""
    ram_budget_gb: float = 0.0
    """RAM for cached photos, blocks and layers, GiB. 0 takes 8, or 40% of the RAM if that is less.
    Does not change results. Setting it turns off automatic workers."""
    workers: int = 0
    """Blocks trained at once, each by its own process. On GPUs this needs Ray, in 'abcd-ns[cluster]'.
    0 takes 1 on a GPU, or with light, poses or a RAM budget set.
    Else it takes all cores, as far as there are two blocks for each."""
    cluster: str | None = None
    """Address (host:port) of the head of a Ray cluster that runs the workers.
    The folders of data and outputs must be paths that all its machines see."""
    max_seconds: float | None = None
    """Stop after this many seconds of training. Evaluation and saving do not count."""

    def check_ranges(self) -> None:
        """Look for options that are out of range, those of training too; a UserError names the first."""
        check_not_below_0(self, NOT_BELOW_0)
        if self.blocks > MAX_BLOCKS:
            raise UserError(f"--pipeline.blocks must be {MAX_BLOCKS} or less, not {self.blocks}.")
        if self.max_seconds is not None and not 0 < self.max_seconds < math.inf:
            raise UserError(f"--pipeline.max-seconds must be above 0 and finite, not {self.max_seconds}.")
        self.training.check()
