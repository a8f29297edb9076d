"""How many Gaussians fit on the device: a model to plan with, and a look before memory is taken.

The model adds up what a visit must hold, and rounds up. `tests/simulated/test_memory.py` compares it with
live tensors, `abcd compare --tiles` with what a run takes; what a GPU took is in docs/results/gpu.
"""

import math
from dataclasses import dataclass, replace

import psutil
import torch

from abcd_ns.engine.gaussians.spherical_harmonics import NUMBERS_WITHOUT_COLOR
from abcd_ns.engine.layers.layer_renderer import BYTES_PER_PIXEL, LEAST_PASS, PARTS_BYTES
from abcd_ns.engine.render.base import DEVICE_PIXELS, DEVICE_SPLATS
from abcd_ns.engine.render.projection import PRIMITIVES, PrimitiveName
from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.train.recipe import FULL, Limits
from abcd_ns.engine.train.schedule import views_per_step
from abcd_ns.errors import UserError
from abcd_ns.units import bytes_in_words

FLOAT = 4
"""Bytes."""
PROJECTED_FLOATS = 8.2
"""Of each row of a Gaussian in a view: itself, copies sorted by tile, their gradients, sums of residuals."""
PIXEL_FLOATS = 120
"""Of a pixel of a crop in training: picture, photo, F, B, and the windowed moments of SSIM with gradients."""
DRAWN_FLOATS = 24
"""Of a pixel that is drawn into layers: colour, transmittance, depth and last Gaussian, of two, twice."""
LAYER_SHARE = 1 / 8
"""Of the device's budget, for the layers of a visit."""
PHOTO_SHARE = 1 / 8
"""Of the device's budget, for photos that are kept there."""
ACTIVE_COPIES = 5
"""Of each value while a block is active: the parameter, its gradient, two moments, and the stored block."""


@dataclass(frozen=True)
class DeviceNeeds:
    """What training takes on the device, bytes: the larger of what a step and what drawing layers takes.

    Args:
        pixels: of the largest image.
        batch: views that are drawn at once.
        in_parts: whether a step draws others after them, whose gradients are added to theirs.
        crop_pixels: of a view that a step trains on at most; 0 is no limit.
        levels: layers of one view that are held, at most, while blocks are folded, see `levels_of`.
        keeps: whether layers and photos are kept there, too. Not on the CPU, whose RAM has a budget for them.
        primitive: what a Gaussian is.
        active_degree: of harmonics of an active block; None for `sh_degree`, that of the scene.
    """

    pixels: int
    batch: int
    sh_degree: int = 3
    crop_pixels: int = 0
    levels: int = 2
    keeps: bool = True
    primitive: PrimitiveName = "3dgs"
    active_degree: int | None = None
    in_parts: bool = False

    @property
    def parameter_bytes(self) -> int:
        """Of one Gaussian's parameters, while it is active."""
        return parameter_bytes(self.sh_degree if self.active_degree is None else self.active_degree)

    @property
    def gaussian_bytes(self) -> int:
        """Of one Gaussian in training: parameters, gradients, two moments, and what drawings hold of it."""
        return (4 + self.in_parts) * self.parameter_bytes + self.batch * projected_bytes(self.primitive)

    @property
    def step_bytes(self) -> int:
        """Of a step's pictures."""
        drawn = min(self.crop_pixels or self.pixels, self.pixels)
        return self.batch * drawn * PIXEL_FLOATS * FLOAT

    @property
    def drawing_bytes(self) -> int:
        """Of whole views while F and B are drawn, which is before the first step: layers while they are
        folded, views that are being drawn, and the least pass of frozen Gaussians."""
        parts = max(PARTS_BYTES, self.levels * BYTES_PER_PIXEL * self.pixels)
        return parts + self._drawn_bytes if self.levels else 0

    @property
    def _drawn_bytes(self) -> int:
        frozen, drawn = parameter_bytes(self.sh_degree), projected_bytes(self.primitive)
        pixels = max(self.pixels, DEVICE_PIXELS) * DRAWN_FLOATS * FLOAT
        return pixels + LEAST_PASS * frozen + DEVICE_SPLATS * drawn

    def frozen_beside(self, active: int) -> int:
        """Frozen Gaussians that a pass may draw in the room for gradients and drawings of active ones."""
        free = active * (self.gaussian_bytes - 3 * self.parameter_bytes)
        return free // frozen_bytes(self.sh_degree, self.primitive)

    @property
    def parts_bytes(self) -> int:
        """Of the layers that are held while they are folded: what the steps that follow will take anyway."""
        return max(PARTS_BYTES, self.step_bytes - self._drawn_bytes)

    @property
    def fixed_bytes(self) -> int:
        """Whatever the block: what is held in a step or while layers are drawn."""
        return max(self.step_bytes, self.drawing_bytes)

    def layer_bytes(self, budget: int) -> int:
        """What of `budget` bytes is for the layers of a visit."""
        return int(LAYER_SHARE * budget) if self.keeps and self.levels else 0

    def photo_bytes(self, budget: int) -> int:
        """What of `budget` bytes is for photos."""
        return int(PHOTO_SHARE * budget) if self.keeps else 0

    def left(self, budget: int) -> int:
        """What of `budget` bytes is left for training, when layers and photos have theirs."""
        return budget - self.layer_bytes(budget) - self.photo_bytes(budget)

    def block_limit(self, budget: int) -> int:
        """Gaussians that a block may have for its visits to stay within `budget` bytes; may be 0 or less."""
        return (self.left(budget) - self.fixed_bytes) // self.gaussian_bytes


def coarse_model_size(config: TrainingConfig, block: int, pixels: int) -> int:
    """Gaussians of the warm-up: if not given, as many as take no more than a visit to one of several blocks
    with `block` Gaussians, on images of so many pixels at most."""
    visit, warm_up = (needs_of(config, pixels, blocks) for blocks in (2, 1))
    # By steps alone: room for layers, which a visit needs and the warm-up does not, would hold many blocks.
    room = visit.step_bytes + block * visit.gaussian_bytes - warm_up.step_bytes
    return config.limits.coarse_gaussians or room // warm_up.gaussian_bytes


def needs_of(config: TrainingConfig, pixels: int, blocks: int, sh_degree: int | None = None) -> DeviceNeeds:
    """What a visit takes in a scene of so many blocks, of degree `sh_degree`; None for `growing_degree`."""
    return needs_of_step(config, pixels, views_per_step(config.batch, blocks), sh_degree)


def needs_of_step(
    config: TrainingConfig, pixels: int, views: int, sh_degree: int | None = None
) -> DeviceNeeds:
    """The same where a step has so many views."""
    limits = config.limits
    at_once, crop = min(views, limits.batch_limit or views), limits.crop_pixels
    sh_degree = config.growing_degree if sh_degree is None else sh_degree
    options = {"primitive": config.primitive, "active_degree": sh_degree, "in_parts": views > at_once}
    return DeviceNeeds(pixels, at_once, config.sh_degree, crop, **options)


def limits_at(config: TrainingConfig, sh_degree: int) -> Limits:
    """The limits of a run whose blocks have come to this degree of spherical harmonics."""
    limits = config.limits
    if sh_degree <= config.growing_degree:
        return limits

    def at_degree(limit: int, blocks: int) -> int:
        before, now = (needs_of(config, 0, blocks, degree).gaussian_bytes for degree in (None, sh_degree))
        return limit * before // now

    sole, block = at_degree(limits.sole_limit, 1), at_degree(limits.block_limit, 2)
    return replace(limits, sole_limit=sole, block_limit=block)


def degree_with_room(config: TrainingConfig, gaussians: int) -> int:
    """The highest degree for which a block alone, of so many Gaussians, has room."""
    least = config.growing_degree
    degrees = range(config.sh_degree, least, -1)
    return next((d for d in degrees if gaussians <= FULL * limits_at(config, d).of_block(1)), least)


def levels_of(blocks: int) -> int:
    """As many as a balanced tree of so many blocks is deep, and one; 0 where a block is the whole scene."""
    return 0 if blocks == 1 else math.ceil(math.log2(blocks)) + 1


class OutOfRoomError(UserError):
    """A block is too large for the memory that is free."""


def parameter_bytes(sh_degree: int) -> int:
    """Of one Gaussian: 59 floats with spherical harmonics of degree 3."""
    return FLOAT * (NUMBERS_WITHOUT_COLOR + 3 * (sh_degree + 1) ** 2)


def projected_bytes(primitive: PrimitiveName) -> int:
    """Of what a Gaussian is in one view: 14 rows of an ellipsoid, 19 of a surfel; see Splats."""
    return round(PROJECTED_FLOATS * PRIMITIVES[primitive].rows) * FLOAT


def frozen_bytes(sh_degree: int, primitive: PrimitiveName) -> int:
    """Of a Gaussian that is drawn without gradients: its parameters and its rows of one view, both twice."""
    return 2 * parameter_bytes(sh_degree) + 2 * PRIMITIVES[primitive].rows * FLOAT


def free_bytes(device: torch.device) -> int:
    """What `device` has left, memory that torch holds in reserve included."""
    if device.type != "cuda":
        return psutil.virtual_memory().available
    reserve = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    return free_on_gpu(device) + reserve


def free_on_gpu(device: torch.device) -> int:
    """What a GPU has left, whatever uses the rest."""
    # torch 2.4 takes no device without a number.
    number = torch.cuda.current_device() if device.index is None else device.index
    return torch.cuda.mem_get_info(number)[0]


def check_room(gaussians: int, sh_degree: int, device: torch.device) -> None:
    """Refuse a block that cannot fit, by an OutOfRoomError that says what would help."""
    needed, free = gaussians * parameter_bytes(sh_degree) * ACTIVE_COPIES, free_bytes(device)
    if needed > free:
        raise OutOfRoomError(
            f"A block of {gaussians:,} Gaussians takes {bytes_in_words(needed)}, but {device} has "
            f"{bytes_in_words(free)} left; set --pipeline.training.density.max-gaussians, or more "
            "--pipeline.blocks."
        )
