"""What fits this machine: blocks, workers, how much of a photo a step draws, and what is kept in RAM."""

import math
from bisect import bisect_left
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import psutil
import torch

from abcd_ns.cluster.forked_workers import can_fork
from abcd_ns.data import DOWNSCALE
from abcd_ns.engine.layers.layer_renderer import LEAST_PASS
from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.train.memory import PHOTO_SHARE, DeviceNeeds, free_on_gpu, levels_of, needs_of
from abcd_ns.engine.train.recipe import FULL, Limits, Recipe
from abcd_ns.errors import UserError
from abcd_ns.machine import threads_wanted
from abcd_ns.run.options import RunOptions
from abcd_ns.units import GIB, bytes_in_words

EXPECTED_GROWTH = 5  # Gaussians at the end for each initial point, where no limit is set; for forecasts only
FREE_SHARE = 0.9  # of a GPU's free memory: the rest is for what the allocator cannot use
LEAST_BLOCK, LEAST_LIMIT = 1_000, 100
"""Gaussians: a block with room for fewer is not worth a visit. The second holds for `gaussian_bytes`."""
FEW = 4  # blocks: each step trains one, so where there would be more, fewer harmonics make them fewer
PICTURE_SHARE = 0.75
"""Of what layers and photos leave of the budget, for a step's pictures at most; the rest is for Gaussians."""
LEAST_CROP = 250_000  # pixels: smaller parts of a view are mostly border
BLOCKS_EACH = 2  # blocks for each worker at least, if no number is given: one in training, one stored


@dataclass(frozen=True)
class Fit:
    """What a budget allows."""

    blocks: int  # to begin with: as few as hold the initial Gaussians
    budget: int  # bytes of the device that training may take
    gaussians: int  # expected in the whole scene at the end
    limits: Limits  # what a run keeps to; `block_limit` is 0 where there is no room for several blocks

    @property
    def blocks_at_the_end(self) -> int:
        """If as many Gaussians come as are expected."""
        if not self.limits.block_limit:
            return self.blocks
        return max(self.blocks, _fewest(self.gaussians, self.limits.block_limit, self.limits.sole_limit))

    def in_words(self) -> str:
        """One line for the terminal."""
        blocks = "1 block" if self.blocks == 1 else f"{self.blocks} blocks"
        limits, most = self.limits, self.limits.of_block(self.blocks) or self.limits.sole_limit
        grows = "a block that comes near that is cut in two."
        if not limits.block_limit:
            why = "there is no room for the layers of more, and the scene" if self.blocks == 1 else "each"
            grows = f"{why} stops growing at that."
        budget = f"{bytes_in_words(self.budget)} of the device allow {most:,} Gaussians in a block"
        said = f"{budget}: {blocks} to begin with; {grows}"
        if limits.crop_pixels:
            said += f" Photos are large: steps draw parts of {limits.crop_pixels / 1e6:.2g} megapixels."
        if late := limits.late_harmonics:
            degrees = "highest degree" if late == 1 else f"{late} highest degrees"
            said += f" Harmonics of the {degrees} come after growth."
        return said


def device_budget(wanted_gb: float, device: torch.device) -> int:
    """Bytes of the device that training may take; 0 takes a share of a GPU's free memory or of the RAM."""
    if wanted_gb > 0:
        return int(wanted_gb * GIB)
    if device.type == "cuda":
        return int(FREE_SHARE * free_on_gpu(device))
    return int(0.25 * psutil.virtual_memory().total)


@dataclass(frozen=True)
class Demand:
    """What is to be trained on a device."""

    pixels: int  # of the largest image
    points: int  # Gaussians that the scene begins with
    training: TrainingConfig
    factor: int = 1  # by which the photos were reduced
    blocks: int = 1  # that there are already
    on_cpu: bool = False  # whether layers and photos are kept in RAM, under a budget of their own

    @property
    def first(self) -> int:
        """Gaussians at the start."""
        return min(self.points, self.training.density.limit or self.points)

    @property
    def gaussians(self) -> int:
        """Gaussians expected at the end."""
        return self.training.density.limit or EXPECTED_GROWTH * self.points

    def reduced(self, times: int) -> "Demand":
        """The same on smaller photos."""
        return replace(self, pixels=max(self.pixels // times**2, 1), factor=self.factor * times)

    @property
    def at_once(self) -> int:
        """Views that are drawn at once: one unless a limit is set, since memory is short."""
        return self.training.limits.batch_limit or 1

    def needs(self, blocks: int, crop_pixels: int, levels: int) -> DeviceNeeds:
        """What that takes in one block or several."""
        limits = replace(self.training.limits, batch_limit=self.at_once, crop_pixels=crop_pixels)
        needs = needs_of(replace(self.training, limits=limits), self.pixels, blocks)
        return replace(needs, levels=levels, keeps=not self.on_cpu)

    def fit(self, budget: int, blocks: int, **limits: int) -> Fit:
        """So many blocks within `budget` bytes and these limits."""
        limits = replace(self.training.limits, batch_limit=self.at_once, **limits)
        return Fit(blocks, budget, self.gaussians, limits)

    def with_fewer_harmonics(self) -> Iterator["Demand"]:
        """The same with all degrees of harmonics while blocks grow, then with ever fewer."""
        for late in range(self.training.sh_degree + 1):
            limits = replace(self.training.limits, late_harmonics=late)
            yield replace(self, training=replace(self.training, limits=limits))

    def most_beside(self, limit: int) -> int:
        """Frozen Gaussians that a pass may draw beside a block at its limit, with all its harmonics."""
        needs = self.needs(2, 0, levels=0)
        whole = replace(needs, active_degree=needs.sh_degree)
        return whole.frozen_beside(limit * needs.gaussian_bytes // whole.gaussian_bytes)


def fit_run(
    options: RunOptions, budget: int, pixels: int, factor: int, gaussians: int, on_cpu: bool, blocks: int = 1
) -> Fit:
    """What a run's options allow within `budget` bytes; see Demand for the others, find_fit for errors."""
    room, demand = options.gaussian_bytes, Demand(pixels, gaussians, options.training, factor, blocks, on_cpu)
    if not room:
        return find_fit(budget, demand)
    if (fit := _best(_fit_gaussians(room, each) for each in demand.with_fewer_harmonics())) is None:
        limit = room // demand.needs(2, 0, levels=0).gaussian_bytes
        raise UserError(f"{bytes_in_words(room)} have room for {limit} Gaussians: give more, or more points.")
    return fit


def find_fit(
    budget: int, demand: Demand, *, downscale: str = DOWNSCALE, memory: str = "--pipeline.device-budget-gb"
) -> Fit:
    """The fewest blocks whose visits stay within `budget` bytes. Where whole views leave no room, steps draw
    parts. One block needs no room for layers. A UserError if no block worth a visit fits; it names values of
    the options `downscale` and `memory` that do."""
    each = list(demand.with_fewer_harmonics())
    if (fit := _best(_fit(budget, one) for one in each)) is None:
        raise UserError(_refusal(budget, each[-1], downscale, memory))
    return fit


def _best(fits: Iterable[Fit | None]) -> Fit | None:
    """The first with FEW blocks; if none has, the last."""
    found = None
    for fit in fits:
        found = fit or found
        if fit is not None and fit.blocks <= FEW:
            break
    return found


def _fit_gaussians(room: int, demand: Demand) -> Fit | None:
    """The fewest blocks whose Gaussians take no more than `room` bytes, pictures and layers apart."""
    sole, limit = (room // demand.needs(blocks, 0, levels=0).gaussian_bytes for blocks in (1, 2))
    if limit < LEAST_LIMIT:
        return None
    blocks, overlap = _fewest(demand.first, limit, sole), demand.training.recipe.overlap
    if overlap > 0:  # an isolated block begins with what lies around its cell, too, and is never cut
        blocks, limit, sole = _fewest(math.ceil((1 + 2 * overlap) ** 2 * demand.first), limit, 0), 0, limit
    kept = {"crop_pixels": 0, "pass_gaussians": demand.most_beside(limit or sole)}
    return demand.fit(room, blocks, block_limit=limit, sole_limit=sole, **kept)


def _fit(budget: int, demand: Demand) -> Fit | None:
    """As `find_fit` with these harmonics; None where nothing fits."""
    crop = _crop(budget, demand)
    # A single block has no neighbours, so it may be larger.
    sole = demand.needs(1, crop, levels=0).block_limit(budget)
    limit, levels = 0, levels_of(2)
    while (found := demand.needs(2, crop, levels).block_limit(budget)) >= LEAST_BLOCK:
        deepest = levels_of(_fewest(demand.gaussians, found, 0))
        if deepest <= levels:
            limit = found
            break
        levels = deepest
    fits_in_one = demand.blocks == 1 and sole >= LEAST_BLOCK and demand.first <= FULL * sole
    if not limit and not fits_in_one:
        return None
    blocks = 1 if fits_in_one else _fewest(demand.first, limit, 0)
    kept = {"crop_pixels": crop, "pass_gaussians": max(demand.most_beside(limit), LEAST_PASS)}
    return demand.fit(budget, blocks, block_limit=limit, sole_limit=max(sole, 0), **kept)


def _crop(budget: int, demand: Demand) -> int:
    """As much of a view as leaves room for Gaussians; 0 for all of it."""
    asked = demand.training.limits.crop_pixels
    room = PICTURE_SHARE * demand.needs(2, 0, levels_of(2)).left(budget)
    if asked or demand.needs(2, 0, levels=0).step_bytes <= room:
        return asked
    of_a_pixel = DeviceNeeds(1, demand.at_once).step_bytes
    return min(max(int(room / of_a_pixel), LEAST_CROP), demand.pixels)


def _fewest(gaussians: int, limit: int, sole: int) -> int:
    """Blocks for so many Gaussians."""
    return 1 if gaussians <= FULL * sole else max(2, math.ceil(gaussians / max(FULL * limit, 1.0)))


def _refusal(budget: int, demand: Demand, downscale: str, memory: str) -> str:
    """Why nothing fits, and which options would help."""
    least = _least_budget(budget, demand)
    ways = f"more memory by {memory} {least:.2f}, if the device has it"
    for times in (2, 4, 8, 16, 32, 64):
        if _fit(budget, demand.reduced(times)) is not None:
            ways = f"smaller photos by {downscale} {times * demand.factor}, or {ways}"
            break
    return (
        f"Training on photos of {demand.pixels / 1e6:.2g} megapixels takes {least:.2f} GiB of the device, "
        f"and {budget / GIB:.2f} GiB may be taken: give {ways}."
    )


def _least_budget(budget: int, demand: Demand) -> float:
    """The least that suffices, GiB, to two digits."""
    step = GIB // 100
    low = high = budget // step + 1
    while _fit(high * step, demand) is None:
        high *= 2
    return bisect_left(range(high), True, low, key=lambda n: _fit(n * step, demand) is not None) / 100


def photo_bytes(options: RunOptions, device: torch.device) -> int:
    """Of the device, for photos: 0 on a CPU, and beside workers, of which one shares this device."""
    if device.type == "cpu" or has_workers(options):
        return 0
    return int(PHOTO_SHARE * device_budget(options.device_budget_gb, device))


def has_workers(options: RunOptions) -> bool:
    """Whether workers are asked for."""
    return options.workers > 1 or options.cluster is not None


def blocks_to_begin_with(fit: Fit, workers: int) -> int:
    """As few as fit the device, but enough for every worker, of which 0 stands for one process. A UserError
    if workers have no room."""
    if workers and not fit.limits.block_limit:
        raise UserError(
            f"{bytes_in_words(fit.budget)} of the device have no room for a block among others, which "
            "workers need: train without workers, or on smaller photos."
        )
    return max(fit.blocks, BLOCKS_EACH * workers)


def works_at_once(recipe: Recipe) -> bool:
    """Whether a method can train several blocks at once."""
    return not recipe.exact and recipe.overlap == 0


def number_of_workers(asked: int, blocks: int, training: TrainingConfig, device: torch.device) -> int:
    """`RunOptions.workers`, its 0 resolved for a scene of that many blocks."""
    if asked:
        return asked
    # Workers learn nothing of light and poses: two of them may show one photo.
    learns = training.light != "none" or training.poses != "off"
    if learns or not works_at_once(training.recipe) or not can_fork(device):
        return 1
    return max(min(threads_wanted(), blocks // BLOCKS_EACH), 1)


@dataclass(frozen=True)
class RamShares:
    """Bytes for what could be read or drawn again. None of them changes a result."""

    photos: int  # decoded photos
    blocks: int  # frozen blocks, read from the store
    layers: int  # a visit's layers; where there is a GPU, those that have no room there

    @staticmethod
    def of(gibibytes: float) -> "RamShares":
        """A quarter of them for photos, one for blocks, the rest for layers. 0 takes 8 GiB, or 40% of the
        machine's memory if that is less."""
        automatic = min(8 * GIB, int(0.4 * psutil.virtual_memory().total))
        budget = int(gibibytes * GIB) if gibibytes else automatic
        photos = blocks = budget // 4
        return RamShares(photos, blocks, budget - photos - blocks)
