"""Blocks, memory, disk and time of a run on these photos, from one step that is timed."""

import shutil
import time
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median

import psutil
import torch
from jaxtyping import Float
from rich.console import Console
from torch import Tensor

from abcd_ns import methods
from abcd_ns.cli.plan import Wanted
from abcd_ns.cluster.dispatcher import SLACK
from abcd_ns.engine.gaussians.initialize import cloud_from_points, random_points, shuffled, thin_points
from abcd_ns.engine.render import make_rasterizer
from abcd_ns.engine.space.partition import build_kd
from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.train.memory import DeviceNeeds, levels_of, needs_of
from abcd_ns.engine.train.schedule import evenly, views_per_step
from abcd_ns.engine.train.step.batch import Sample, part_to_draw
from abcd_ns.engine.types import Gaussians, View
from abcd_ns.nerfstudio.datamanager import AbcdDataManagerConfig
from abcd_ns.nerfstudio.dataparser import AbcdDataParserConfig
from abcd_ns.nerfstudio.views import training_views
from abcd_ns.run.fit import Demand, Fit, RamShares, blocks_to_begin_with, device_budget, find_fit
from abcd_ns.terminal import many, print_facts
from abcd_ns.units import bytes_in_words

STATES = 3  # parameters and two moments are kept of each Gaussian
GENERATIONS = 2  # of the store on disk: the one in use, and the one that the last checkpoint pins
TIMED_STEPS = 3
PLACES = {
    "device": ("on the device", "may be taken", "leave --blocks out, or give more of them"),
    "RAM": ("of RAM", "are free", "limit the scene by --max-gaussians, or free memory"),
    "disk": ("of disk", "are free in this folder", "use `ns-train --output-dir` on another disk"),
}
"""Where memory is needed, and the words for a lack of it, with the fix."""
DAY = 24  # hours from which on a forecast names ways to take less
LOST = {1 / 4: 0.8, 1 / 8: 0.9, 1 / 16: 2.8}
"""dB below one block, by the share of its memory for Gaussians that a block has. The most of four scenes, 160
px wide (docs/results/README.md)."""
LAYERS_BY_STEPS = 0.15
"""Time for layers by the time of steps. Runs of 8 blocks on a CPU take 2 to 8% for them, of 19 up to 39%."""


@dataclass(frozen=True)
class Capture:
    """What there is to train on."""

    points: Float[Tensor, "n 3"]
    colors: Float[Tensor, "n 3"]
    views: list[View]
    factor: int = 1  # by which the photos were reduced


def read(data: Path, downscale: int | None, console: Console) -> Capture:
    """The training views and the points, as training has them; photos are looked at, not decoded."""
    parser = AbcdDataParserConfig(downscale_factor=downscale)
    config = AbcdDataManagerConfig(data=data, dataparser=parser)
    with console.status("Reading the capture"):
        manager = config.setup(device="cpu", test_mode="val")
        dataset = manager.train_dataset
        options = methods.abcd.config.pipeline
        seeds = dataset.metadata.get("points3D_xyz"), dataset.metadata.get("points3D_rgb")
        views = training_views(dataset.cameras, seeds[0])
        if seeds[0] is None:  # as training begins then
            seeds = random_points(options.model.num_random, options.model.random_scale)
        else:
            seeds = thin_points(*(seed.float() for seed in seeds), views, options.training.point_pixels)
        return Capture(*seeds, views, manager.dataparser.factor)


@dataclass(frozen=True)
class Forecast:
    """All that `abcd plan` prints."""

    wanted: Wanted
    factor: int
    fit: Fit
    batch: int
    points_of_block: tuple[int, ...]
    shares: dict[str, dict[str, int]]  # bytes by place and by what takes them, see `shares_of`
    free: dict[str, int]  # bytes that may be taken there
    seconds_per_step: float  # measured with the initial points

    @property
    def hours(self) -> tuple[float, float]:
        """Of the whole run: with as many Gaussians as points, and with as many as are expected."""
        layers = 1 + LAYERS_BY_STEPS * (self.fit.blocks_at_the_end > 1)
        low = self.wanted.steps * self.seconds_per_step * layers / 3600
        return low, low * max(self.fit.gaussians / max(sum(self.points_of_block), 1), 1.0)

    @property
    def quality(self) -> str | None:
        """What it costs that memory limits the scene, or cuts it into blocks; None where it does neither."""
        limits, share = self.fit.limits, self.fit.limits.sole_limit / max(self.fit.gaussians, 1)
        if not 0 < share < 1:
            return None
        if not limits.block_limit:
            most = f"limited to {limits.sole_limit:,} Gaussians"
            return f"{most}: there is no room for the layers of several blocks"
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


def forecast(capture: Capture, wanted: Wanted, console: Console) -> Forecast:
    """Cut the points into blocks, and time a step; UserError where the device has no room for any block."""
    training = methods.abcd.config.pipeline.training
    if 0 < wanted.max_gaussians < len(capture.points):  # training begins with no more
        rows = shuffled(len(capture.points), training.seed)[: wanted.max_gaussians]
        capture = replace(capture, points=capture.points[rows], colors=capture.colors[rows])
    points, views = capture.points, capture.views
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    pixels = max(view.full.pixels for view in views)
    on_cpu = device.type == "cpu"
    training = replace(training, density=replace(training.density, max_gaussians=wanted.max_gaussians))
    demand = Demand(pixels, len(points), training, factor=capture.factor, on_cpu=on_cpu)
    fit = _fit(device_budget(wanted.device_budget_gb, device), demand, wanted)
    training = replace(training, limits=fit.limits)
    owner = build_kd(points, fit.blocks).assign(points)
    counts = owner.bincount(minlength=fit.blocks)
    batch = views_per_step(training.batch, fit.blocks)
    needs = needs_of(training, pixels, fit.blocks)
    needs = replace(needs, levels=levels_of(fit.blocks), keeps=not on_cpu)
    fullest = owner == counts.argmax()
    gaussians = cloud_from_points(points[fullest], capture.colors[fullest]).gaussians().to(device)
    spread = [view.to(device) for view in evenly(views, batch)]
    with console.status("Timing a step"):
        seconds = time_steps(gaussians, spread, training)
    photo_bytes = sum(3 * view.full.pixels for view in views)
    return Forecast(
        wanted=wanted,
        factor=capture.factor,
        fit=fit,
        batch=batch,
        points_of_block=tuple(counts.tolist()),
        shares=shares_of(fit, needs, photo_bytes, wanted.workers),
        free={
            "device": fit.budget,
            "RAM": psutil.virtual_memory().available,
            "disk": shutil.disk_usage(Path.cwd()).free,
        },
        seconds_per_step=seconds,
    )


def _fit(budget: int, demand: Demand, wanted: Wanted) -> Fit:
    """As training has it: blocks whose number is given are as large as they become."""
    if wanted.blocks:
        return Fit(wanted.blocks, budget, demand.gaussians, demand.training.limits)
    fit = find_fit(budget, demand, downscale="--downscale", memory="--device-budget-gb")
    workers = wanted.workers if wanted.workers > 1 else 0
    return replace(fit, blocks=blocks_to_begin_with(fit, workers))


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
    largest, limit = -(-fit.gaussians // fit.blocks), fit.limits.of_block(fit.blocks)
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


def time_steps(gaussians: Gaussians, views: list[View], training: TrainingConfig) -> float:
    """Seconds that a step on these Gaussians and views takes, forward and backward; the best of a few.

    On a CPU those in which this thread computes: what else runs on the machine now does not count.
    """
    clock = time.perf_counter if gaussians.device.type == "cuda" else time.thread_time
    rasterizer = make_rasterizer("auto", gaussians.device, primitive=training.primitive)
    rasterizer.warm_up()
    leaves = Gaussians(**{name: value.clone().requires_grad_() for name, value in gaussians.items()})
    best, black = float("inf"), torch.zeros(3, device=gaussians.device)
    for step in range(TIMED_STEPS):
        began = clock()
        crops = [part_to_draw(training, view.full, step, place) for place, view in enumerate(views)]
        samples = [Sample(*drawn, None, None, black) for drawn in zip(views, crops, strict=True)]
        rasters = rasterizer.draw(leaves, [sample.shot for sample in samples], sh_degree=training.sh_degree)
        losses = [
            sample.loss(raster.color, torch.zeros_like(raster.color), training)
            for sample, raster in zip(samples, rasters, strict=True)
        ]
        torch.stack(losses).mean().backward()
        if gaussians.device.type == "cuda":
            torch.cuda.synchronize(gaussians.device)
        best = min(best, clock() - began)
    return best


def print_forecast(found: Forecast, console: Console, verbose: bool = False) -> None:
    """A few lines and a table for people; `verbose` says where the figures come from."""
    fit = found.fit
    at_the_end = f", {fit.blocks_at_the_end} in the end" if fit.blocks_at_the_end > fit.blocks else ""
    (low, high), most = found.hours, many(found.batch, "view", "views")
    views = f"up to {most}" if found.batch > 1 else most
    rows = {
        "blocks": f"{fit.blocks}{at_the_end}",
        "Gaussians": f"{sum(found.points_of_block):,} points to begin with, {fit.gaussians:,} expected",
        "time": f"{in_words(low)} to {in_words(high)}: {found.wanted.steps:,} steps of {views}",
    }
    if found.quality:
        rows["quality"] = found.quality
    if found.wanted.workers > 1:
        each = "each with as much of a GPU, or of the RAM, as the device below"
        rows["workers"] = f"{found.wanted.workers}, {each}"
    for place, shares in found.shares.items():
        free = f", {bytes_in_words(found.free[place])} may be taken" if place in found.free else ""
        rows[place] = f"{bytes_in_words(sum(shares.values()))} at most{free}"
        rows |= {f"  {what}": bytes_in_words(nbytes) for what, nbytes in shares.items() if verbose}
    if verbose:
        points = found.points_of_block
        rows["points by block"] = f"{min(points):,} to {max(points):,}, median {median(points):,.0f}"
        rows["a step on the points"] = f"{found.seconds_per_step:.3f} s"
        limited = fit.limits.sole_limit > 0
        rows["limits"] = fit.in_words() if limited else "none of a block's Gaussians, as --blocks is given"
    print_facts(rows, console)
    for line in found.warnings:
        console.print(f"[bold red]does not fit:[/] {line}", highlight=False)
    if found.advice:
        console.print(f"[yellow]note:[/] {found.advice}", highlight=False)
    if not (found.warnings or verbose):
        console.print("\nAll of it fits. What takes the memory: abcd plan --verbose", highlight=False)
