"""What a run will need: blocks and the views that see them, memory, disk and time."""

import time
from dataclasses import dataclass
from typing import Annotated

import torch
import tyro

from abcd_ns.cluster.dispatcher import SLACK
from abcd_ns.engine.render import Shot, make_rasterizer
from abcd_ns.engine.render.loss import photometric_loss, ssim_windows
from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.train.memory import DeviceNeeds
from abcd_ns.engine.train.step.batch import part_to_draw
from abcd_ns.engine.types import Gaussians, View
from abcd_ns.lab.runs.options import Number
from abcd_ns.run.fit import Fit, RamShares
from abcd_ns.units import bytes_in_words

STATES = 3
"""Parameters and two moments are kept of each Gaussian."""
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
LOST = {1 / 4: 1.2, 1 / 8: 2.4, 1 / 16: 3.5}
"""dB below one block, by the share of its memory for Gaussians that a block has. The most of four scenes, 160
px wide (docs/results/README.md)."""
LAYERS_BY_STEPS = 0.15
"""Time for layers by the time of steps: they take 10 to 18% of runs on a CPU (docs/results)."""


@dataclass(frozen=True)
class Wanted:
    """What a run is to be like."""

    blocks: Number = 0
    """Number of blocks. 0 takes as few as the device's budget permits."""
    device_budget_gb: Annotated[float, tyro.conf.arg(metavar="GiB")] = 0.0
    """Memory of the device that training may take.
    0 takes 90% of a GPU's free memory, or a quarter of the RAM on a CPU."""
    max_gaussians: Number = 0
    """Limit on Gaussians in the scene. 0 sets none; the forecast is five for each point."""
    steps: Number = 30_000
    """Steps of the run."""
    workers: Number = 1
    """Blocks trained at once, each by a process on its own GPU or on a part of the cores."""


@dataclass(frozen=True)
class Forecast:
    """All that `abcd plan` prints."""

    wanted: Wanted
    factor: int
    """By which the photos' width and height are divided."""
    fit: Fit
    batch: int
    points_of_block: tuple[int, ...]
    shares: dict[str, dict[str, int]]
    """Bytes by place and by what takes them, see `shares_of`."""
    free: dict[str, int]
    """Bytes that may be taken there."""
    seconds_per_step: float
    """Measured with the initial points."""

    @property
    def hours(self) -> tuple[float, float]:
        """Of the whole run: with as many Gaussians as points, and with as many as are expected."""
        layers = 1 + LAYERS_BY_STEPS * (self.fit.blocks_at_the_end > 1)
        low = self.wanted.steps * self.seconds_per_step * layers / 3600
        return low, low * max(self.fit.gaussians / max(sum(self.points_of_block), 1), 1.0)

    @property
    def quality(self) -> str | None:
        """What it costs that memory limits the scene, or cuts it into blocks; None where it does neither."""
        fit, share = self.fit, self.fit.sole / max(self.fit.gaussians, 1)
        if not 0 < share < 1:
            return None
        if not fit.limit:
            return f"limited to {fit.sole:,} Gaussians: there is no room for the layers of several blocks"
        lost = min((lost for least, lost in LOST.items() if share >= least), default=None)
        found = f"up to {lost} dB in four small scenes, below" if lost else "not measured, below that of"
        return f"{found} one block with {1 / share:.1f} times this memory"

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
    def advice(self) -> str | None:
        """What helps if the run would take long."""
        if self.hours[1] < DAY:
            return None
        return (
            f"This may take {in_words(self.hours[1])}. `ns-train abcd --pipeline.max-seconds 7200` ends "
            f"it after two hours. Smaller photos (--downscale {2 * self.factor}) and fewer --steps help."
        )


def in_words(hours: float) -> str:
    """A duration in minutes, hours or days."""
    if hours >= 2 * DAY:
        return f"{hours / DAY:.0f} days"
    return f"{hours * 60:.0f} min" if hours < 2 else f"{hours:.0f} h"


def shares_of(fit: Fit, needs: DeviceNeeds, photo_bytes: int, workers: int) -> dict[str, dict[str, int]]:
    """What a run takes at most, by place of PLACES; and, with workers, what moves for a visit by one.

    RAM is beside Python and torch. A worker's machine caches what it was sent until that changes.
    """
    # The largest block, as far as can be said.
    largest, limit = -(-fit.gaussians // fit.blocks), fit.sole if fit.blocks == 1 else fit.limit
    largest = min(largest, limit) if limit else largest
    scene, block = fit.gaussians * needs.parameter_bytes, largest * needs.parameter_bytes
    there_and_back, kept = 2 * STATES * block, RamShares.of(0)
    shares = {
        "device": {
            f"a block of {largest:,} Gaussians in training": largest * needs.gaussian_bytes,
            "a step's pictures, or layers while they are drawn": needs.fixed_bytes,
            "layers that are kept": needs.layer_bytes(fit.budget),
            "photos that are kept": needs.photo_bytes(fit.budget),
        },
        "RAM": {
            "decoded photos": min(photo_bytes, kept.photos),
            "frozen blocks": min(scene, kept.blocks),
            "the whole scene, while a checkpoint is written": scene,
        },
        "disk": {"blocks with their optimiser's state": GENERATIONS * STATES * scene, "checkpoint": scene},
    }
    if workers > 1:
        in_flight = SLACK * workers * there_and_back + scene
        shares["RAM"]["blocks in flight, there and back, and those around them"] = in_flight
        shares["sent a visit"] = {
            "its block, with the optimiser's state, there and back": there_and_back,
            "the blocks around it, as they are drawn": scene - block,
        }
    return shares


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
        shots = [Shot(v, part_to_draw(training, v.full, step, k)) for k, v in enumerate(views[:batch])]
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
