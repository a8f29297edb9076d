"""The options of a run, beside those of training itself."""

from dataclasses import dataclass, field
from typing import Literal

from abcd_ns.engine.train.config import TrainingConfig


@dataclass
class RunOptions:
    """How space is cut, how its blocks are trained, and on which memory and workers."""

    training: TrainingConfig = field(default_factory=TrainingConfig)
    """How blocks are trained."""
    blocks: int = 0
    """Number of blocks. 0 takes as few as `device_budget_gb` allows and splits those that outgrow it. A
    number forces that many blocks; the memory budget is then not enforced."""
    device_budget_gb: float = 0.0
    """Device memory for training, GiB; sets the number of blocks where `blocks` is 0. Of a GPU's, an eighth
    is for layers and one for photos. 0 takes 90% of a GPU's free memory; on a CPU, a quarter of the RAM."""
    partition: Literal["kd", "grid"] = "kd"
    """kd: cells with equally many points. grid: equal cells, as the paper has, at least `blocks` of them."""
    near_plane: float = 0.0
    """Gaussians closer to a camera than this, along its axis, are not drawn; world units. 0 takes half
    the nearest distance at which a photo shows a point."""
    ram_budget_gb: float = 0.0
    """RAM for cached photos, blocks and layers, GiB. Does not change results. Setting it turns off automatic
    workers. 0 takes 8, or 40% of the machine's memory where that is less."""
    workers: int = 0
    """Blocks that are trained at once, each by a process of its own: on a core each, or on a GPU each, which
    needs Ray (pip install 'abcd-ns[cluster]'). 0 takes all cores where there is no GPU, as far as there are
    two blocks for each; and else, or with `ram_budget_gb`, light or poses set, one."""
    cluster: str | None = None
    """Address (host:port) of the head of a Ray cluster that is to have the workers, instead of this machine;
    --data and --output-dir must be paths that all its machines see."""
    max_seconds: float | None = None
    """Stop after this many seconds of training; evaluation and saving do not count."""
