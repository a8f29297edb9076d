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
    face by this share of its extent. Needs `layers` and `migrate` off."""
    exact: bool = False
    """Exact joint training: every step trains all blocks, one at a time on the device, each drawn twice.
    Slow; the reference for gradients. What concerns visits has no effect."""
    ownership: Literal["fragments", "means"] = "fragments"
    """What a layer holds: fragments in a cell (exact) or, as in the paper, Gaussians with means in it."""
    window_weight: float = 0.06
    """Frozen fragments between a block's nearest and farthest ones are sorted in with these, tile by tile.
    This share of the block's weight, in a picture of it alone, may lie nearer than the nearest that counts,
    and as much farther than the farthest. 0 counts all: exact and slow."""
    influence_share: float = 0.995
    """A block is trained on the fewest views with this share of its influence, and in each on a crop with
    this share of its weight. 1 takes all views and pixels that it may touch, and layers of all blocks."""
    visit_views: int = 64
    """Views that a visit to the median block uses; others the same share of theirs, at most twice this."""
    passes: int = 8
    """Uses of each of these views in a visit; in proportion fewer where they are more than 32."""
    visit_steps: int = 0
    """Steps of every visit, as the paper has; 0 shares steps out by views."""
    keep_moments: bool = True
    """A block keeps Adam's moments and densification's statistics from visit to visit. Off in the paper."""
    migrate: bool = True
    """Gaussians that left their cell in a visit move to another block. Off in the paper: they are deleted."""
    sh_restart: bool = False
    """The degree of spherical harmonics rises from 0 in every visit, as in the paper; frozen blocks are then
    drawn with the highest."""
    sh_ramp: float = 0.1
    """Share of the run over which the degree rises from 0 to the highest."""
    limit_scales: bool = True
    """Shrink oversized Gaussians where blocks are trained within layers, and let none grow."""
    means_lr_decay: float = 0.1
    """What the means' learning rate falls to over the run, exponentially, as a share. The final decay takes
    another tenth, which together is 3DGS's hundredth."""
    pixel_loss: Literal["l1", "l2"] = "l1"
    """Mean absolute difference, as 3DGS, or mean squared difference, as the paper with `ssim_lambda` 0."""
    fast_start: bool = True
    """Learning rates are larger while a block was trained on few views, see
    `param_swap.rates_of_under_trained`, and fall at the end of the run, see `schedule.final_decay`."""
    dropout: float = 0.2
    """Share of Gaussians that a step leaves out at the end of a run on very few photos; less before, and with
    more photos. None with 16, nor in a visit to a block among others. See `step.dropout`."""
    trained_before: int = 0
    """Views that every block counts as trained on when the run begins."""


FULL = 0.9
"""Share of its limit over which a block is cut: the next visit needs room to grow."""


@dataclass(frozen=True)
class Limits:
    """What fits on the device; `ns-train` derives it from its memory. 0 is no limit unless said otherwise."""

    block_limit: int = 0
    """Gaussians that a block may hold while it is trained; one over FULL of it is cut when its visit ends."""
    sole_limit: int = 0
    """The same for a block that is the whole scene, which draws one view in a step. 0 takes `block_limit`."""
    batch_limit: int = 0
    """Views of a step that are drawn at once, at most; the others follow. Results agree to rounding."""
    crop_pixels: int = 0
    """Pixels of a view that a step trains on at most: a random part of larger crops, see `random_part`."""
    coarse_gaussians: int = 0
    """Gaussians of the warm-up's coarse model at most; 0 is as many as there are in the beginning."""
    late_harmonics: int = 0
    """Degrees of spherical harmonics that come once growth is over, as far as there is room. The other limits
    count on that."""
    pass_gaussians: int = 0
    """Frozen Gaussians drawn in one pass at most; 0 takes twice the largest block, at least 200,000."""

    def of_block(self, blocks: int) -> int:
        """Gaussians that a block may hold in a scene of so many; 0 is no limit."""
        return (self.sole_limit if blocks == 1 else 0) or self.block_limit

    def is_full(self, gaussians: int, blocks: int) -> bool:
        """Whether a block of so many Gaussians, in a scene of so many blocks, is to be cut."""
        return self.block_limit > 0 and gaussians > FULL * self.of_block(blocks)
