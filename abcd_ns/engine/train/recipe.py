"""What makes a method, as opposed to what tunes one; and what the device's memory decides."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Recipe:
    """What the methods of `ns-train` differ in; its command line does not offer it."""

    layers: bool = True
    """Composite each block with the frozen blocks around it. Off is the paper's ablation."""
    overlap: float = 0.0
    """Above 0: partition, train, merge. Each block is trained once, by itself, on its cell enlarged at each
    face by this share of its extent, and keeps what lies in its cell at the end. Needs `layers` and `migrate`
    off."""
    exact: bool = False
    """Exact joint training: every step trains all blocks, one at a time on the device, each drawn twice.
    Slow; the reference for gradients. There are no visits, so what concerns them has no effect."""
    ownership: Literal["fragments", "means"] = "fragments"
    """What a layer holds: the fragments in a cell (exact) or the Gaussians with their mean in it (as the
    paper)."""
    window_weight: float = 0.06
    """Frozen fragments between a block's nearest and farthest ones are sorted in with these, in each tile of
    4 x 4 pixels (gsplat: 16 x 16). This share of the block's weight, in a picture of it alone, may lie nearer
    than the nearest that counts, and as much farther than the farthest. 0 counts all: exact and slow."""
    influence_share: float = 0.995
    """A block is trained on the fewest views that hold this share of its influence, that is of its weight in
    the pictures; others hardly show it. Known from the warm-up. And in each view on a crop that holds this
    share of what it weighs there alone. 1 takes all views and pixels that it may touch, and layers of all
    blocks."""
    visit_views: int = 64
    """Views that a visit uses of a block that as many views see as the median block. Others use the same
    share of theirs, and twice as many at most."""
    passes: int = 8
    """Uses of each of these views in a visit, where they are 32 or fewer; in proportion fewer uses where they
    are more."""
    visit_steps: int = 0
    """Steps of every visit, whatever the views that see its block, as the paper has; 0 shares steps out by
    views."""
    keep_moments: bool = True
    """A block keeps Adam's moments and densification's statistics from visit to visit. Off, as in the paper,
    every visit begins with new ones."""
    migrate: bool = True
    """Gaussians that left their cell by the end of a visit move to the block that holds them. Off, as in the
    paper, they are deleted."""
    sh_restart: bool = False
    """The degree of spherical harmonics rises from 0 in every visit, over `sh_ramp` of its steps, as in the
    paper; frozen blocks are then drawn with the highest."""
    sh_ramp: float = 0.1
    """Share of the run over which the degree rises from 0 to the highest."""
    limit_scales: bool = True
    """Shrink oversized Gaussians where blocks are trained within layers, and let none grow.
    Non-finite values are repaired in any case."""
    means_lr_decay: float = 0.1
    """What the means' learning rate falls to over the run, exponentially, as a share. The final decay takes
    another tenth, which together is 3DGS's hundredth."""
    pixel_loss: Literal["l1", "l2"] = "l1"
    """Mean absolute difference, as 3DGS, or mean squared difference, as the paper with `ssim_lambda` 0."""
    fast_start: bool = True
    """Learning rates are larger while a block was trained on few views, see
    `param_swap.rates_of_under_trained`, and fall at the end of the run, see `schedule.final_decay`."""
    trained_before: int = 0
    """Views that every block counts as trained on when the run begins."""


FULL = 0.75
"""Share of its limit over which a block is cut: the next visit needs room to grow."""


@dataclass(frozen=True)
class Limits:
    """What fits on the device: `ns-train` derives it from the memory that training may take. 0 is no limit
    but where another meaning stands."""

    block_limit: int = 0
    """Gaussians that a block may hold while it is trained; one that comes near it is cut in two when its
    visit ends."""
    sole_limit: int = 0
    """The same for a block that is the whole scene: it has no neighbours, and draws one view in a step, so
    there is room for more. 0 takes `block_limit`."""
    batch_limit: int = 0
    """Views of a step that are drawn at once, at most; the others follow. Results agree to rounding."""
    crop_pixels: int = 0
    """Pixels of a view that a step trains on at most. Of larger crops a step takes a random rectangle,
    another one each time, and weighs it by how much of the crop it leaves out."""
    coarse_gaussians: int = 0
    """Gaussians of the warm-up's coarse model at most, see `memory.coarse_model_size`; 0 is as many as there
    are in the beginning."""
    late_harmonics: int = 0
    """Degrees of spherical harmonics that blocks do not have while they grow, which the other limits count
    on. They come once growth is over, as far as there is room."""
    pass_gaussians: int = 0
    """Frozen Gaussians drawn in one pass at most; 0 takes twice the largest block, at least 200,000."""

    def of_block(self, blocks: int) -> int:
        """Gaussians that a block may hold in a scene of so many; 0 is no limit."""
        return (self.sole_limit if blocks == 1 else 0) or self.block_limit

    def is_full(self, gaussians: int, blocks: int) -> bool:
        """Whether a block of so many Gaussians, in a scene of so many blocks, is to be cut."""
        return self.block_limit > 0 and gaussians > FULL * self.of_block(blocks)
