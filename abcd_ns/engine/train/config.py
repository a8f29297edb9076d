"""How a scene is trained: every option of the engine, with its default."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Literal

from abcd_ns.engine.gaussians.spherical_harmonics import MAX_SH_DEGREE
from abcd_ns.engine.render.projection import PrimitiveName
from abcd_ns.engine.train.capture.light import Kind as LightKind
from abcd_ns.engine.train.capture.poses import Kind as PosesKind
from abcd_ns.engine.train.density.control import DensityConfig
from abcd_ns.engine.train.recipe import Limits, Recipe
from abcd_ns.errors import UserError

_OF_DENSITY = ("max_gaussians", "min_contribution", "split_pixels", "refine_every")
NOT_BELOW_0 = ("batch", "point_pixels", "commit_seconds", *(f"density.{name}" for name in _OF_DENSITY))


def check_not_below_0(options: object, names: Iterable[str], within: str = "") -> None:
    """Raise a UserError if a number, by its dotted name, is below 0 or not finite. The options are those
    `within` --pipeline."""
    for name in names:
        if not 0 <= (value := attrgetter(name)(options)) < math.inf:
            flag = f"--pipeline.{within}{name.replace('_', '-')}"
            raise UserError(f"{flag} must be 0 or more and finite, not {value}.")


@dataclass
class TrainingConfig:
    """How a scene is trained, whatever calls the engine."""

    recipe: Recipe = field(default=Recipe())
    """What makes the method; set by the method's definition."""
    limits: Limits = field(default=Limits())
    """What fits on the device; set by the caller, which knows its memory."""
    primitive: PrimitiveName = "3dgs"
    """What a Gaussian is: an ellipsoid (3DGS) or a flat disc, a surfel (2DGS). Part of the scene."""
    sh_degree: int = 3
    """Highest degree of spherical harmonics, 0 to 3."""
    background: Literal["random", "black", "white"] = "random"
    """What lies behind the scene while training."""
    light: LightKind = "none"
    """Colour transform of each finished picture, for photos taken in different light.
    exposure: a gain for each channel. affine: a 3 x 4 matrix.
    The mean over the photos is the identity. Held-out views are drawn with it and scored as `cc_psnr` too."""
    poses: PosesKind = "off"
    """SO3xR3 refines the poses of the training photos by pictures of the whole scene.
    Rounds run in the warm-up and between visits; with workers, in the warm-up only."""
    antialiased: bool = False
    """Scale opacities by gsplat's compensation for its low-pass filter."""
    warmup: float = 0.35
    """Share of the run that trains a coarse model of the whole scene, before blocks. 0 for none.
    Lasts up to 2.4 times as long, until each view was used 32 times.
    Ends after 24 uses of each view if not all points have room."""
    coarse: float = 0.2
    """Share of the run in which the warm-up, or a scene of one block, is trained on reduced pictures.
    First at a quarter of their width, then at half. No side falls below 100 pixels. 0 for none."""
    batch: int = 0
    """Views per step. 0 takes 1 with one block and in the warm-up.
    Elsewhere 0 takes 4, and fewer for a block that was trained on few views."""
    ssim_lambda: float = 0.2
    """Weight of 1 - SSIM in the loss; the rest is the difference of pixels."""
    point_pixels: float = 2.0
    """Points in a cube this many pixels wide start as one Gaussian. 0 starts with all.
    The width is that in the view that sees the points from nearest."""
    commit_seconds: float = 60.0
    """Seconds of the run that a kill may cost; blocks are written to disk beside the training.
    0 commits at the end of every visit, which waits for the disk."""
    seed: int = 0
    """Seed of the order of blocks and views, and of backgrounds."""
    density: DensityConfig = field(default_factory=DensityConfig)
    """Growing and pruning."""

    @property
    def growing_degree(self) -> int:
        """Highest degree of spherical harmonics while blocks grow."""
        return max(self.sh_degree - self.limits.late_harmonics, 0)

    def room(self, scene: int, block: int, limit: int) -> int | None:
        """Gaussians that may be added to a block with a limit, 0 for none; None for any number."""
        rooms = [] if self.density.limit is None else [self.density.limit - scene]
        rooms += [limit - block] if limit else []
        return min(rooms, default=None)

    def check(self) -> None:
        """Look for options that are out of range or contradict each other; a UserError names the first."""
        check_not_below_0(self, NOT_BELOW_0, "training.")
        recipe = self.recipe
        for name, fits, words in (
            ("warmup", 0 <= self.warmup < 1, "from 0 to below 1"),
            ("coarse", 0 <= self.coarse < 1, "from 0 to below 1"),
            ("sh-degree", 0 <= self.sh_degree <= MAX_SH_DEGREE, f"from 0 to {MAX_SH_DEGREE}"),
            ("ssim-lambda", 0 <= self.ssim_lambda <= 1, "from 0 to 1"),
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
