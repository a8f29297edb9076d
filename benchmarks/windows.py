"""What it costs to give z windows by tiles of 16 px, as gsplat has them, and not of 4 px as on the CPU.

    python -m benchmarks.windows --data DIR --downscale 1 --blocks 8 --steps 200 --seeds 0 1 --out FILE

Trains the same scene with windows of each side, by the torch rasterizer and for equally many steps; compares

- PSNR of held-out views, merged;
- the ordering gap: PSNR between merged and composited pictures of these views;
- frozen fragments that a step draws beside the block's own, as a share of all: a larger tile has a wider
  window, as it holds every depth at which the block shows anywhere in it;
- milliseconds for each view drawn to train, layers left out.
"""

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro

from abcd_ns.engine.gaussians.param_swap import live_gaussians
from abcd_ns.engine.layers.painter import Painter, PaintSettings
from abcd_ns.engine.render import TorchRasterizer
from abcd_ns.engine.render.loss import psnr
from abcd_ns.engine.render.tile_grid import TileGrid
from abcd_ns.engine.store.scene import MemoryScene
from abcd_ns.engine.train.coordinator import Coordinator
from abcd_ns.engine.train.step.batch import Sample
from abcd_ns.engine.train.training_loop import train_step
from abcd_ns.engine.types import Gaussians
from abcd_ns.lab.results.tables import markdown
from abcd_ns.lab.stability.lab import Stage, merged
from abcd_ns.lab.stability.scenarios.real import read_stage
from benchmarks.runs import Asked, write_runs
from benchmarks.visit import begin
from tests.reference.rasterizer_scenes import bin_splats, fragments_in

COUNTED = 10
"""Fragments are counted in one of so many steps."""


@dataclass(kw_only=True)
class Args(Asked):
    """What to compare."""

    downscale: int = 1
    steps: int = 200
    seeds: tuple[int, ...] = (0, 1)
    """A pair of runs for each."""
    sides: tuple[int, ...] = (4, 16)
    """Of the windows' tiles, px; multiples of 4."""


@dataclass
class Counts:
    """Fragments drawn by steps, and how long steps took."""

    own: int = 0
    frozen: int = 0
    views: int = 0
    seconds: float = 0.0


@dataclass(frozen=True)
class Row:
    """One run."""

    side: int
    seed: int
    psnr: float
    gap: float
    frozen_share: float
    """Of the fragments that a step draws."""
    ms_per_view: float
    gaussians: int
    steps: int


def count(rasterizer: TorchRasterizer, own: Gaussians, samples: tuple[Sample, ...], counts: Counts) -> None:
    """Add up the fragments that a step is about to draw."""
    for sample in samples:
        grid, frozen = TileGrid(sample.crop, rasterizer.tile_side), sample.shot.frozen
        seen = rasterizer.project(own, sample.view)
        counts.own += fragments_in(bin_splats(seen, grid, rasterizer.chunk))
        if frozen is not None:
            lists = bin_splats(frozen, grid, rasterizer.chunk, window=sample.window)
            counts.frozen += fragments_in(lists)


def run(capture: Stage, side: int, seed: int, args: Args) -> Row:
    """Train and look at held-out views."""
    rasterizer, counts = TorchRasterizer(window_side=side), Counts()
    with tempfile.TemporaryDirectory() as folder:
        options = {"steps": args.steps, "seed": seed, "rasterizer": rasterizer}
        coordinator = begin(capture, args.blocks, Path(folder), **options)
        train(coordinator, capture, rasterizer, counts)
        gaussians, tree = merged(coordinator), coordinator.scene.tree
        coordinator.close()
    painter = Painter(
        MemoryScene(tree, gaussians), capture.held_out, rasterizer, ownership="fragments", pass_gaussians=0
    )
    errors, gaps = [], []
    for view, photo in zip(capture.held_out, capture.truth, strict=True):
        with torch.no_grad():
            picture = rasterizer(gaussians, view, sh_degree=3).color.clamp(0, 1)
        composited = painter.picture(view, PaintSettings(3)).color.clamp(0, 1)
        errors.append(psnr(picture, photo))
        gaps.append(psnr(picture, composited))
    drawn = max(counts.own + counts.frozen, 1)
    return Row(
        side=side,
        seed=seed,
        psnr=float(torch.stack(errors).mean()),
        gap=float(torch.stack(gaps).mean()),
        frozen_share=counts.frozen / drawn,
        ms_per_view=1e3 * counts.seconds / max(counts.views, 1),
        gaussians=len(gaussians),
        steps=coordinator.state.step,
    )


def train(coordinator: Coordinator, capture: Stage, rasterizer: TorchRasterizer, counts: Counts) -> None:
    """All steps; those in the midst of a visit are timed, and some of them counted."""
    while not coordinator.finished:
        active = coordinator.state.active
        amid = active is not None and not active.is_whole and active.done < active.steps - 1
        if amid and coordinator.state.step % COUNTED == 0:
            samples = coordinator.next_batch().samples
            count(rasterizer, live_gaussians(coordinator.params).detach(), samples, counts)
        began = time.perf_counter()
        train_step(coordinator, capture)
        if amid:
            counts.seconds += time.perf_counter() - began
            counts.views += coordinator.batch


def main(args: Args) -> None:
    """Run all pairs, print the table, write the file."""
    capture, rows = read_stage(args.data, args.downscale), []
    TorchRasterizer().warm_up()
    for k, seed in enumerate(args.seeds):
        for side in args.sides if k % 2 == 0 else args.sides[::-1]:  # the machine's speed drifts
            rows.append(run(capture, side, seed, args))
            print(rows[-1], flush=True)
    table = [["side", "seed", "PSNR", "gap", "frozen", "ms a view", "Gaussians"]]
    for row in sorted(rows, key=lambda row: (row.side, row.seed)):
        table.append([f"{row.side}", f"{row.seed}", f"{row.psnr:.2f}", f"{row.gap:.1f}"])
        table[-1] += [f"{row.frozen_share:.1%}", f"{row.ms_per_view:.1f}", f"{row.gaussians:,}"]
    print(markdown(table))
    write_runs(args.out, {"data": args.data.name, **args.of_all_runs}, rows)


if __name__ == "__main__":
    main(tyro.cli(Args))
