"""How a scene is trained: every option of the engine, with its default."""

from dataclasses import dataclass, field
from typing import Literal

from abcd_ns.engine.train.density.control import DensityConfig


@dataclass
class TrainingConfig:
    """How a scene is trained, whatever calls the engine."""

    layers: bool = True
    """Composite each block with the frozen blocks around it. Off is the paper's ablation."""
    overlap: float = 0.0
    """Above 0: partition, train, merge. Each block is trained once, by itself, on its cell enlarged at each
    face by this share of its extent, and keeps what lies in its cell at the end. Needs `layers` off."""
    exact: bool = False
    """Exact joint training: every step trains all blocks, one at a time on the device, each drawn twice.
    Slow; the reference for gradients. There are no visits, so what concerns them has no effect."""
    ownership: Literal["fragments", "means"] = "fragments"
    """What a layer holds: the fragments in a cell (exact) or the Gaussians with their mean in it (as the
    paper)."""
    window_weight: float = 0.06
    """Frozen fragments between a block's nearest and farthest ones are sorted in with these, in each tile of
    4 x 4 pixels (gsplat: 16 x 16). This much of their weight, in a picture of the block alone, may be nearer
    than the nearest that counts, and as much farther than the farthest; 0 counts all, which is exact and
    dear."""
    warmup: float = 0.2
    """Share of the run, at most, for which a scaffold is trained before blocks are: as many Gaussians, all
    over the scene, as take no more memory than a visit to the largest block. 0 for none."""
    scaffold_passes: int = 24
    """Uses of each view in the warm-up, at most: so few Gaussians soon are as good as they can be. 0 for no
    such limit."""
    scaffold_gaussians: int = 0
    """Gaussians of the scaffold; 0 takes as many as the memory of a visit allows."""
    batch: int = 0
    """Views drawn in one step. 0 takes 1 where the scene is one block, which is 3DGS, and 4 elsewhere: with
    small blocks a step's overhead would outweigh its work. The warm-up draws 2 at most."""
    batch_limit: int = 0
    """Views in a step at most where `batch` is 0; 0 is none. `ns-train abcd` sets it by the device's
    memory."""
    crop_pixels: int = 0
    """Pixels of a view that a step trains on at most. Of larger crops a step takes a random rectangle,
    another one each time, and weighs it by how much of the crop it leaves out. 0 is no limit; `ns-train abcd`
    sets it by the device's memory where not even one whole view fits."""
    batch_power: float = 1.0
    """Learning rates grow with this power of the views in a step: 0.5 suits gradients that are noise, 1 such
    as agree. A scene's views show different Gaussians, but a block's all show the same ones."""
    processes: int = 0
    """Processes that share the views of a step where there is no GPU; 0 takes as many as torch has threads,
    `batch` at most. Rounding depends on it."""
    influence_share: float = 0.995
    """A block is trained on the fewest views that hold this share of its influence, that is of its weight in
    the pictures; others hardly show it. Known from the warm-up; 1 takes all views that see the block."""
    visit_views: int = 32
    """Views that a visit uses, for the block that most views see; others use the same share of theirs."""
    first_passes: int = 4
    """Uses of each of these views in a visit of the first sweep."""
    last_passes: int = 0
    """Uses of each of these views in a visit of late sweeps; one more with each sweep until then. 0 takes as
    many as leave a tenth of the time for drawing layers, by the Gaussians of a block and around it."""
    visit_steps: int = 0
    """Steps of every visit, whatever the views that see its block, as the paper has; 0 shares steps out by
    views."""
    keep_moments: bool = True
    """A block keeps Adam's moments and densification's statistics from visit to visit. Off, as in the paper,
    every visit begins with new ones."""
    sh_restart: bool = False
    """The degree of spherical harmonics rises from 0 in every visit, over `sh_ramp` of its steps, as in the
    paper; frozen blocks are then drawn with the highest."""
    migrate: bool = True
    """Gaussians that left their cell by the end of a visit move to the block that holds them. Off, as in the
    paper, they are deleted."""
    heal: bool = True
    """Where blocks are trained within layers: undo a visit that left its pictures worse than it found them,
    shrink giants, drop what no picture can show. Values that are no numbers are mended in any case."""
    block_limit: int = 0
    """Gaussians that a block may hold while it is trained; one that comes near it is cut in two when its
    visit ends. 0 is none; `ns-train abcd` sets it by the device's memory."""
    sole_limit: int = 0
    """The same for a block that is the whole scene: it has no neighbours, and draws one view in a step, so
    there is room for more. 0 takes `block_limit`."""
    commit_seconds: float = 60.0
    """A kill loses at most so many seconds of the run; what happens is written to disk beside the training.
    0 commits at the end of every visit, which waits for the disk."""
    pass_gaussians: int = 0
    """Frozen Gaussians drawn in one pass at most; 0 takes twice the largest block, at least 200,000."""
    sh_degree: int = 3
    """Highest degree of spherical harmonics."""
    sh_ramp: float = 0.1
    """Share of the run over which the degree rises from 0 to the highest."""
    ssim_lambda: float = 0.2
    """Weight of 1 - SSIM in the loss; the rest is `pixel_loss`."""
    pixel_loss: Literal["l1", "l2"] = "l1"
    """Mean absolute difference, as 3DGS, or mean squared difference, as the paper with `ssim_lambda` 0."""
    antialiased: bool = False
    """Scale opacities by gsplat's compensation for its low-pass filter."""
    background: Literal["random", "black", "white"] = "random"
    """What lies behind the scene while training."""
    means_lr_decay: float = 0.01
    """Learning rate of the means at the end, as a share of the start's; exponential over the run."""
    seed: int = 0
    """Of the order of blocks and views, backgrounds and splits."""
    density: DensityConfig = field(default_factory=DensityConfig)
    """Growing and pruning."""

    def room(self, scene: int, block: int, blocks: int) -> int | None:
        """Gaussians that may be added to a block of so many in a scene of so many and of so many blocks; None
        for any number."""
        limit = self.block_limit if blocks > 1 else self.sole_limit or self.block_limit
        rooms = [] if self.density.limit is None else [self.density.limit - scene]
        rooms += [limit - block] if limit else []
        return min(rooms, default=None)
