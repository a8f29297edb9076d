"""What pictures look like from nearer and from farther than the photos: PSNR at other sizes than trained.

    python -m benchmarks.zoom --data DIR --downscale 4 --steps 1000 --blocks 8 --seeds 0 1 --out FILE

Trains on photos of one size, plainly and antialiased, and draws the held-out views at others, of the same
cameras: at twice the size pixels are half as large, as if the camera stood at half the distance.
"""

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean

import torch
import tyro

from abcd_ns.engine.render import TorchRasterizer
from abcd_ns.engine.render.loss import psnr
from abcd_ns.engine.train.training_loop import train_step
from abcd_ns.engine.types import Gaussians
from benchmarks.runs import whole, write_runs
from benchmarks.visit import Capture, begin, read


@dataclass
class Args:
    """What to train and draw."""

    data: Path
    """The scene, as for `ns-train abcd --data`."""
    downscale: int = 4
    """Divides the photos' width and height for training."""
    drawn: tuple[int, ...] = (16, 8, 4, 2)
    """The same for the pictures that are scored."""
    blocks: int = 8
    """Of the scene."""
    steps: int = 1000
    """Of each run."""
    seeds: tuple[int, ...] = (0,)
    """A pair of runs for each."""
    out: Path | None = None
    """Where to write the results, JSON."""


@dataclass(frozen=True)
class Row:
    """One run."""

    antialiased: bool
    seed: int
    psnr: dict[int, float]
    """Of held-out views, dB, by downscale."""
    gaussians: int


def run(captures: dict[int, Capture], antialiased: bool, seed: int, args: Args) -> Row:
    """Train on one size, score all."""
    capture, rasterizer = captures[args.downscale], TorchRasterizer()
    with tempfile.TemporaryDirectory() as folder:
        options = {"steps": args.steps, "seed": seed, "antialiased": antialiased}
        coordinator = begin(capture, args.blocks, Path(folder), rasterizer=rasterizer, **options)
        while not coordinator.finished:
            train_step(coordinator, capture.photo)
        gaussians = whole(coordinator)
        coordinator.close()
    scores = {size: score(gaussians, captures[size], rasterizer, antialiased) for size in args.drawn}
    return Row(antialiased, seed, scores, len(gaussians))


@torch.no_grad()
def score(gaussians: Gaussians, capture: Capture, rasterizer: TorchRasterizer, antialiased: bool) -> float:
    """Mean PSNR of the held-out views, dB."""
    errors = []
    for view in capture.held_out:
        drawn = rasterizer(gaussians, view, sh_degree=3, antialiased=antialiased).color.clamp(0, 1)
        errors.append(float(psnr(drawn, capture.held_out_photo(view.index, view.full))))
    return fmean(errors)


def main(args: Args) -> None:
    """Run all pairs, print the table, write the file."""
    captures = {size: read(replace(args, downscale=size)) for size in {args.downscale, *args.drawn}}
    rows = []
    print("| antialiased | seed | Gaussians |" + "".join(f" 1/{size} |" for size in args.drawn))
    print("| --- | ---: | ---: |" + " ---: |" * len(args.drawn))
    for seed in args.seeds:
        for antialiased in (False, True):
            rows.append(row := run(captures, antialiased, seed, args))
            scores = "".join(f" {row.psnr[size]:.2f} |" for size in args.drawn)
            print(f"| {'yes' if antialiased else 'no'} | {seed} | {row.gaussians:,} |{scores}", flush=True)
    asked = {"data": args.data.name, "downscale": args.downscale, "blocks": args.blocks}
    write_runs(args.out, {**asked, "steps": args.steps}, rows)


if __name__ == "__main__":
    main(tyro.cli(Args))
