"""What a run will need: blocks and the views that see them, memory, disk and time."""

import time
from dataclasses import dataclass

import torch
from torch import Tensor

from abcd_ns.cluster.dispatcher import SLACK
from abcd_ns.engine.render import Shot, make_rasterizer
from abcd_ns.engine.render.loss import photometric_loss, ssim_windows
from abcd_ns.engine.space.tree import BlockTree
from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.train.health_record import TOO_FEW_VIEWS
from abcd_ns.engine.train.memory import DeviceNeeds
from abcd_ns.engine.train.step.batch import part_to_draw
from abcd_ns.engine.types import Gaussians, View
from abcd_ns.run.fit import Fit, RamShares
from abcd_ns.units import bytes_in_words

STATES = 3
"""Parameters and two moments are kept of each Gaussian."""
MOST_POINTS = 200_000
"""Of more than these, an evenly spaced choice is looked at."""
GENERATIONS = 2
"""Of the store on disk: the one in use, and the one that the last checkpoint pins."""
TIMED_STEPS = 3
PLACES = {
    "device": ("on the device", "may be taken", "leave --blocks out, or give more of them"),
    "RAM": ("of RAM", "are free", "limit the scene by --max-gaussians, or free memory"),
    "disk": ("of disk", "are free in this folder", "use `ns-train --output-dir` on another disk"),
}
"""Where memory is needed, and the words for a lack of it, with the fix."""
DAY = 24
"""Hours from which on a forecast names ways to take less."""
LAYERS_BY_STEPS = 0.15
"""Time for layers by the time of steps: they take 10 to 18% of runs on a CPU (docs/results)."""


Shares = dict[str, int]
"""Bytes, by what takes them."""


@dataclass(frozen=True)
class Forecast:
    """All that `abcd plan` prints."""

    fit: Fit
    points: int
    batch: int
    views_of_block: tuple[int, ...]
    """By block, the training views in which one of its points is."""
    points_of_block: tuple[int, ...]
    shares: dict[str, Shares]
    """By place, of PLACES."""
    free: dict[str, int]
    """Bytes that may be taken there."""
    steps: int
    seconds_per_step: float
    """Measured with the initial points."""
    workers: int
    factor: int
    """By which the photos' width and height are divided."""
    sent: Shares
    """What a visit by a worker moves; nothing without workers."""

    @property
    def hours(self) -> tuple[float, float]:
        """Of the whole run: with as many Gaussians as points, and with as many as are expected."""
        layers = 1 + LAYERS_BY_STEPS * (self.fit.blocks_at_the_end > 1)
        low = self.steps * self.seconds_per_step * layers / 3600
        return low, low * max(self.fit.gaussians / max(self.points, 1), 1.0)

    @property
    def warnings(self) -> list[str]:
        """What would not fit, each with what to do about it."""
        lines = []
        for place, (where, how, cure) in PLACES.items():
            needed, free = sum(self.shares[place].values()), self.free[place]
            if needed > free:
                lines.append(f"{bytes_in_words(needed)} {where}, but {bytes_in_words(free)} {how}: {cure}.")
        return lines

    @property
    def advice(self) -> list[str]:
        """What can be trained, but would take long or turn out badly, each with what to do about it."""
        lines, views = [], self.views_of_block
        few = sum(count <= TOO_FEW_VIEWS for count in views)
        if few and len(views) > 1:
            seen = f"{few} of {len(views)} blocks are seen by fewer than {TOO_FEW_VIEWS + 1} views"
            lines.append(f"{seen}: use fewer --blocks.")
        if self.hours[1] >= DAY:
            lines.append(
                f"This may take {in_words(self.hours[1])}. `ns-train abcd --pipeline.max-seconds 7200` ends "
                f"it after two hours. Smaller photos (--downscale {2 * self.factor}) and fewer --steps help."
            )
        return lines


def in_words(hours: float) -> str:
    """A duration in minutes, hours or days."""
    if hours >= 2 * DAY:
        return f"{hours / DAY:.0f} days"
    return f"{hours * 60:.0f} min" if hours < 2 else f"{hours:.0f} h"


def views_of_blocks(tree: BlockTree, points: Tensor, views: list[View]) -> tuple[int, ...]:
    """By block, the number of views that have one of its points in the picture.

    Args:
        points: [n, 3], world space.
    """
    owner, counts = tree.assign(points), torch.zeros(tree.num_blocks, dtype=torch.int64)
    # Millions of points, for thousands of views, take many minutes. The choice follows the order of blocks,
    # so that each has its share of it: some hundreds of a block's points are enough to tell who sees it.
    chosen = owner.argsort(stable=True)[:: -(-len(points) // MOST_POINTS) or 1]
    owner, points = owner[chosen], points[chosen].double()
    for view in views:
        counts[owner[view.depths_of(points)[1]].unique()] += 1
    return tuple(counts.tolist())


def device_shares(fit: Fit, needs: DeviceNeeds) -> Shares:
    """What a visit to a block of the expected size takes on the device."""
    largest = _largest(fit)
    return {
        f"a block of {largest:,} Gaussians in training": largest * needs.gaussian_bytes,
        "a step's pictures, or layers while they are drawn": needs.fixed_bytes,
        "layers that are kept": needs.layer_bytes(fit.budget),
        "photos that are kept": needs.photo_bytes(fit.budget),
    }


def _largest(fit: Fit) -> int:
    """Gaussians of the largest block, as far as can be said."""
    share, limit = -(-fit.gaussians // fit.blocks), fit.sole if fit.blocks == 1 else fit.limit
    return min(share, limit) if limit else share


def sent_shares(fit: Fit, needs: DeviceNeeds) -> Shares:
    """What a visit by a worker moves at most: a machine caches what it was sent until that changes."""
    block = _largest(fit) * needs.parameter_bytes
    return {
        "its block, with the optimiser's state, there and back": 2 * STATES * block,
        "the blocks around it, as they are drawn": fit.gaussians * needs.parameter_bytes - block,
    }


def ram_shares(fit: Fit, needs: DeviceNeeds, photo_bytes: int, workers: int) -> Shares:
    """What the rest takes in RAM, beside Python and torch."""
    scene = fit.gaussians * needs.parameter_bytes
    out = 2 * SLACK * workers * STATES * _largest(fit) * needs.parameter_bytes
    shares = RamShares.of(0)
    sent = {"blocks in flight, there and back, and those around them": out + scene}
    return (sent if workers > 1 else {}) | {
        "decoded photos": min(photo_bytes, shares.photos),
        "frozen blocks": min(scene, shares.blocks),
        "the whole scene, while a checkpoint is written": scene,
    }


def disk_shares(fit: Fit, needs: DeviceNeeds) -> Shares:
    """What a run leaves and holds on disk."""
    scene = fit.gaussians * needs.parameter_bytes
    return {"blocks with their optimiser's state": GENERATIONS * STATES * scene, "checkpoint": scene}


def time_steps(gaussians: Gaussians, views: list[View], training: TrainingConfig, batch: int) -> float:
    """Seconds that a step on these Gaussians takes, forward and backward; the best of a few.

    On a CPU those in which this thread computes: what else runs on the machine now does not count.
    """
    clock = time.perf_counter if gaussians.device.type == "cuda" else time.thread_time
    rasterizer = make_rasterizer("auto", gaussians.device, primitive=training.primitive)
    rasterizer.warm_up()
    leaves = Gaussians(**{name: value.clone().requires_grad_() for name, value in gaussians.items()})
    best = float("inf")
    for step in range(TIMED_STEPS):
        began = clock()
        shots = [
            Shot(view, part_to_draw(training, view.full, step, place))
            for place, view in enumerate(views[:batch])
        ]
        rasters = rasterizer.draw(leaves, shots, sh_degree=training.sh_degree)
        losses = [
            photometric_loss(
                raster.color,
                torch.zeros_like(raster.color),
                full_pixels=shot.view.full.pixels,
                full_windows=ssim_windows(shot.view.height, shot.view.width),
                ssim_lambda=training.ssim_lambda,
            )
            for shot, raster in zip(shots, rasters, strict=True)
        ]
        torch.stack(losses).mean().backward()
        if gaussians.device.type == "cuda":
            torch.cuda.synchronize(gaussians.device)
        best = min(best, clock() - began)
    return best
