"""`abcd plan`: what a run on these photos needs, and what would not fit."""

import math
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import Annotated

import psutil
import torch
import tyro
from jaxtyping import Float
from rich.console import Console
from torch import Tensor

from abcd_ns import methods
from abcd_ns.cli.plan.forecast import Forecast, Wanted, in_words, shares_of, time_steps
from abcd_ns.cli.terminal import many, print_facts
from abcd_ns.engine.gaussians.initialize import cloud_from_points, random_points, thin_points
from abcd_ns.engine.space.partition import MAX_BLOCKS, build_kd
from abcd_ns.engine.train.memory import levels_of, needs_of
from abcd_ns.engine.train.schedule import views_per_step
from abcd_ns.engine.types import View
from abcd_ns.errors import UserError
from abcd_ns.lab.runs.options import check_ranges
from abcd_ns.nerfstudio.datamanager import AbcdDataManagerConfig
from abcd_ns.nerfstudio.dataparser import AbcdDataParserConfig
from abcd_ns.nerfstudio.views import training_views
from abcd_ns.run.fit import Demand, Fit, blocks_to_begin_with, device_budget, find_fit
from abcd_ns.units import bytes_in_words


@tyro.conf.configure(tyro.conf.FlagCreatePairsOff, tyro.conf.OmitArgPrefixes)
def plan(
    data: Annotated[Path, tyro.conf.arg(metavar="PATH")],
    wanted: Annotated[Wanted, tyro.conf.arg(name="")],
    downscale: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    verbose: bool = False,
) -> int:
    """Predict blocks, memory, disk and time of a run. Trains nothing.

    Times one step. This compiles the kernels if no training has done so yet.

    abcd plan --data garden

    abcd plan --data garden --device-budget-gb 6

    Args:
        data: Folder of the scene, as for `ns-train abcd --data`.
        wanted: Options of the run.
        downscale: Divides the photos' width and height. Left out, no side is over 1600 px, as in training.
        verbose: Show what takes the memory, and the points of the blocks.

    Returns:
        0; 1 if something would not fit.
    """
    if not 0 <= wanted.blocks <= MAX_BLOCKS:
        raise UserError(f"--blocks is {wanted.blocks}; it must lie between 0 and {MAX_BLOCKS}.")
    if not 0 <= wanted.device_budget_gb < math.inf:
        raise UserError(f"--device-budget-gb must be 0 or more and finite, not {wanted.device_budget_gb}.")
    given = {name: getattr(wanted, name) for name in ("max_gaussians", "steps", "workers")}
    check_ranges({**given, "downscale": downscale})
    console = Console()
    found = forecast(read(data, downscale, console), wanted, console)
    print_forecast(found, console, verbose)
    return 1 if found.warnings else 0


@dataclass(frozen=True)
class Capture:
    """What there is to train on."""

    points: Float[Tensor, "n 3"]
    colors: Float[Tensor, "n 3"]
    views: list[View]
    factor: int = 1
    """By which the photos were reduced."""


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


def forecast(capture: Capture, wanted: Wanted, console: Console) -> Forecast:
    """Cut the points into blocks, and time a step; UserError where the device has no room for any block."""
    points, views = capture.points, capture.views
    training = methods.abcd.config.pipeline.training
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    pixels = max(view.full.pixels for view in views)
    most, on_cpu = wanted.max_gaussians or None, device.type == "cpu"
    demand = Demand(pixels, len(points), training, most=most, factor=capture.factor, on_cpu=on_cpu)
    fit = _fit(device_budget(wanted.device_budget_gb, device), demand, wanted)
    training = replace(training, limits=replace(training.limits, **fit.limits))
    tree = build_kd(points, fit.blocks)
    owner = tree.assign(points)
    counts = owner.bincount(minlength=fit.blocks)
    batch = views_per_step(training.batch, fit.blocks)
    needs = needs_of(training, pixels, fit.blocks)
    needs = replace(needs, levels=levels_of(fit.blocks), keeps=not on_cpu)
    fullest = owner == counts.argmax()
    gaussians = cloud_from_points(points[fullest], capture.colors[fullest]).gaussians().to(device)
    spread = [view.to(device) for view in views[:: max(1, len(views) // batch)]]
    with console.status("Timing a step"):
        seconds = time_steps(gaussians, spread, training, batch)
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
        limits = demand.training.limits
        return Fit(wanted.blocks, 0, 0, budget, demand.gaussians, limits.crop_pixels, limits.batch_limit)
    fit = find_fit(budget, demand, downscale="--downscale", memory="--device-budget-gb")
    return replace(fit, blocks=blocks_to_begin_with(fit, wanted.workers if wanted.workers > 1 else 0))


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
        rows["workers"] = (
            f"{found.wanted.workers}, each with as much of a GPU, or of the RAM, as the device below"
        )
    for place, shares in found.shares.items():
        free = f", {bytes_in_words(found.free[place])} may be taken" if place in found.free else ""
        rows[place] = f"{bytes_in_words(sum(shares.values()))} at most{free}"
        rows |= {f"  {what}": bytes_in_words(nbytes) for what, nbytes in shares.items() if verbose}
    if verbose:
        points = found.points_of_block
        rows["points by block"] = f"{min(points):,} to {max(points):,}, median {median(points):,.0f}"
        rows["a step on the points"] = f"{found.seconds_per_step:.3f} s"
        rows["limits"] = fit.in_words() if fit.sole else "none of a block's Gaussians, as --blocks is given"
    print_facts(rows, console)
    for line in found.warnings:
        console.print(f"[bold red]does not fit:[/] {line}", highlight=False)
    if found.advice:
        console.print(f"[yellow]note:[/] {found.advice}", highlight=False)
    if not (found.warnings or verbose):
        console.print("\nAll of it fits. What takes the memory: abcd plan --verbose", highlight=False)
