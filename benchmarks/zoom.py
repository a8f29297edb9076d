"""What pictures look like from nearer and from farther than the photos: PSNR at other sizes than trained.

    python -m benchmarks.zoom --data DIR --downscale 4 --steps 1000 --blocks 8 --seeds 0 1 --out FILE

Trains on photos of one size, plainly and antialiased, and draws the held-out views at others, of the same
cameras: at twice the size pixels are half as large, as if the camera stood at half the distance.
"""

import tempfile
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

import torch
import tyro

from abcd_ns.engine.render import TorchRasterizer
from abcd_ns.engine.render.loss import psnr
from abcd_ns.engine.train.training_loop import train
from abcd_ns.engine.types import Gaussians
from abcd_ns.lab.results.tables import markdown
from abcd_ns.lab.stability.lab import Stage, merged
from abcd_ns.lab.stability.scenarios.real import read_stage
from benchmarks.runs import Asked, write_runs
from benchmarks.visit import begin


@dataclass(kw_only=True)
class Args(Asked):
    """What to train and draw."""

    drawn: tuple[int, ...] = (16, 8, 4, 2)
    """As `downscale`, for the pictures that are scored."""
    steps: int = 1000


@dataclass(frozen=True)
class Row:
    """One run."""

    antialiased: bool
    seed: int
    psnr: dict[int, float]
    """Of held-out views, dB, by downscale."""
    gaussians: int


def run(captures: dict[int, Stage], antialiased: bool, seed: int, args: Args) -> Row:
    """Train on one size, score all."""
    capture, rasterizer = captures[args.downscale], TorchRasterizer()
    with tempfile.TemporaryDirectory() as folder:
        options = {"steps": args.steps, "seed": seed, "antialiased": antialiased}
        coordinator = begin(capture, args.blocks, Path(folder), rasterizer=rasterizer, **options)
        train(coordinator, capture)
        gaussians = merged(coordinator)
        coordinator.close()
    scores = {size: score(gaussians, captures[size], rasterizer, antialiased) for size in args.drawn}
    return Row(antialiased, seed, scores, len(gaussians))


@torch.no_grad()
def score(gaussians: Gaussians, capture: Stage, rasterizer: TorchRasterizer, antialiased: bool) -> float:
    """Mean PSNR of the held-out views, dB."""
    errors = []
    for view, photo in zip(capture.held_out, capture.truth, strict=True):
        drawn = rasterizer(gaussians, view, sh_degree=3, antialiased=antialiased).color.clamp(0, 1)
        errors.append(float(psnr(drawn, photo)))
    return fmean(errors)


def main(args: Args) -> None:
    """Run all pairs, print the table, write the file."""
    captures = {size: read_stage(args.data, size) for size in {args.downscale, *args.drawn}}
    rows = []
    table = [["antialiased", "seed", "Gaussians", *(f"1/{size}" for size in args.drawn)]]
    for seed in args.seeds:
        for antialiased in (False, True):
            rows.append(row := run(captures, antialiased, seed, args))
            scores = [f"{row.psnr[size]:.2f}" for size in args.drawn]
            table.append(["yes" if antialiased else "no", str(seed), f"{row.gaussians:,}", *scores])
            print(row, flush=True)
    print(markdown(table))
    write_runs(args.out, {"data": args.data.name, **args.of_all_runs}, rows)


if __name__ == "__main__":
    main(tyro.cli(Args))
