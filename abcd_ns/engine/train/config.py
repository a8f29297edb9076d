"""How a scene is trained: every option of the engine, with its default."""

import math
from dataclasses import dataclass, field
from typing import Literal

from abcd_ns.engine.gaussians.spherical_harmonics import MAX_SH_DEGREE
from abcd_ns.engine.render.primitive import PrimitiveName
from abcd_ns.engine.train.capture.light import Kind as LightKind
from abcd_ns.engine.train.capture.poses import Kind as PosesKind
from abcd_ns.engine.train.density.control import DensityConfig
from abcd_ns.engine.train.recipe import Limits, Recipe
from abcd_ns.errors import UserError


@dataclass
class TrainingConfig:
    """How a scene is trained, whatever calls the engine."""

    recipe: Recipe = field(default=Recipe())
    """What makes the method; set by whoever defines one."""
    limits: Limits = field(default=Limits())
    """What fits on the device; set by whoever knows its memory."""
    primitive: PrimitiveName = "3dgs"
    """What a Gaussian is: 3DGS's ellipsoid, or the flat disc of 2DGS, a surfel. Part of the scene: whoever
    draws it later takes it from the run's options."""
    window_weight: float = 0.06
    """Frozen fragments between a block's nearest and farthest ones are sorted in with these, in each tile of
    4 x 4 pixels (gsplat: 16 x 16). This much of their weight, in a picture of the block alone, may be nearer
    than the nearest that counts, and as much farther than the farthest; 0 counts all, which is exact and
    dear."""
    warmup: float = 0.35
    """Share of the run for which a scaffold is trained before blocks are: Gaussians all over the scene, which
    grow to as many as take no more memory than a visit to the largest block. Twice as long, if need be, for
    each view to be used 24 times. Where not all points have room it ends after this share or 24 uses of each
    view, whichever comes first. 0 for none."""
    batch: int = 0
    """Views drawn in one step. 0 takes 1 where the scene is one block, which is 3DGS, and in the
    warm-up, and elsewhere 4, but for a block that was trained on few views: with small blocks a step's
    overhead would outweigh its work."""
    influence_share: float = 0.995
    """A block is trained on the fewest views that hold this share of its influence, that is of its weight in
    the pictures; others hardly show it. Known from the warm-up. And in each view on a crop that holds this
    share of what it weighs there alone. 1 takes all views and pixels that it may touch."""
    coarse: float = 0.2
    """Share of the run in which the warm-up, or a scene of one block, is trained on reduced pictures: first
    at a quarter of their width, then at half, where no side is below 100 pixels then. 0 for none."""
    visit_views: int = 64
    """Views that a visit uses, for the block that most views see; others use the same share of theirs."""
    passes: int = 8
    """Uses of each of these views in a visit, where they are 32 or fewer; in proportion fewer uses where they
    are more."""
    heal: bool = True
    """Shrink oversized Gaussians where blocks are trained within layers. Values that are no numbers are
    repaired in any case."""
    commit_seconds: float = 60.0
    """A kill loses at most so many seconds of the run; what happens is written to disk beside the training.
    0 commits at the end of every visit, which waits for the disk."""
    sh_degree: int = 3
    """Highest degree of spherical harmonics."""
    ssim_lambda: float = 0.2
    """Weight of 1 - SSIM in the loss; the rest is the difference of pixels."""
    antialiased: bool = False
    """Scale opacities by gsplat's compensation for its low-pass filter."""
    background: Literal["random", "black", "white"] = "random"
    """What lies behind the scene while training."""
    light: LightKind = "none"
    """Colour transform of each finished picture, for photos taken in different light. exposure: a gain for
    each channel. affine: a 3 x 4 matrix. The mean over the photos is the identity, in which held-out views
    are drawn; these are scored as `cc_psnr`, too."""
    poses: PosesKind = "off"
    """Refines where photos were taken from, by whole pictures in the warm-up and between visits. SO3xR3: how
    each camera turns and where it is. Held-out views keep the poses that were given. With `workers` poses are
    refined in the warm-up only."""
    means_lr_decay: float = 0.1
    """What the means' learning rate falls to over the run, exponentially, as a share; all fall to another
    tenth at its end, which together is 3DGS's hundredth."""
    point_pixels: float = 2.0
    """Points of the cloud that lie in a cube so many pixels wide, in the view that sees them from nearest,
    begin as one Gaussian; 0 begins with all."""
    seed: int = 0
    """Of the order of blocks and views, of backgrounds, and of what `mcmc` moves."""
    density: DensityConfig = field(default_factory=DensityConfig)
    """Growing and pruning."""

    def room(self, scene: int, block: int, blocks: int) -> int | None:
        """Gaussians that may be added to a block of so many in a scene of so many and of so many blocks; None
        for any number."""
        limit = self.limits.of_block(blocks)
        rooms = [] if self.density.limit is None else [self.density.limit - scene]
        rooms += [limit - block] if limit else []
        return min(rooms, default=None)

    def check(self) -> None:
        """Look for options that are out of range or contradict each other.

        Raises:
            UserError: names the first that is.
        """
        recipe = self.recipe
        for name, fits, words in (
            ("warmup", 0 <= self.warmup < 1, "from 0 to below 1"),
            ("coarse", 0 <= self.coarse < 1, "from 0 to below 1"),
            ("sh-degree", 0 <= self.sh_degree <= MAX_SH_DEGREE, f"from 0 to {MAX_SH_DEGREE}"),
            ("influence-share", self.influence_share > 0, "above 0"),
            ("window-weight", 0 <= self.window_weight < 1, "from 0 to below 1"),
            ("batch", self.batch >= 0, "0 or more"),
            ("visit-views", self.visit_views > 0, "above 0"),
            ("means-lr-decay", 0 < self.means_lr_decay < math.inf, "above 0 and finite"),
            ("passes", self.passes > 0, "above 0"),
        ):
            if not fits:
                value = getattr(self, name.replace("-", "_"))
                raise UserError(f"--pipeline.training.{name} must be {words}, not {value}.")
        if self.primitive == "2dgs" and (self.antialiased or self.poses != "off"):
            name = "antialiased" if self.antialiased else "poses"
            raise UserError(f"--pipeline.training.{name} is for 3dgs: gsplat's surfels do not have it.")
        if self.light != "none" and recipe.exact:
            raise UserError("--pipeline.training.light is for methods that train by visits, not abcd-exact.")
        if self.poses != "off" and (recipe.exact or recipe.overlap > 0):
            raise UserError(
                "--pipeline.training.poses is for methods whose blocks are drawn together while they are "
                "trained in turn, not abcd-exact nor abcd-partition."
            )
        if recipe.overlap < 0 or (recipe.overlap > 0 and (recipe.layers or recipe.exact or recipe.migrate)):
            raise UserError(
                f"training.recipe.overlap is {recipe.overlap}: it must be 0, or more where layers, exact "
                "and migrate are off, as in the method abcd-partition."
            )
