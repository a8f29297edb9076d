"""How long the CPU rasterizer takes to draw a whole picture, and to differentiate it.

    python -m benchmarks.rasterizer

All sides run in one process, taking turns; each figure is the median over the rounds. Compiling, caches and
first touches of memory come before the clock starts.
"""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
import tyro
from torch import Tensor

from abcd_ns.engine.render import TorchRasterizer
from abcd_ns.engine.types import Gaussians, View
from abcd_ns.lab.results.tables import markdown
from benchmarks.runs import print_machine

WARM = 2
"""Rounds that are not counted."""
Sides = dict[str, Callable[[], None]]


@dataclass
class Args:
    """What to measure."""

    gaussians: int = 26_000
    """Number of Gaussians in the synthetic scene."""
    widths: tuple[int, ...] = (160, 320)
    """Of the pictures, pixels; they are two thirds as high."""
    rounds: int = 7
    """Timed rounds per figure; the median is reported."""
    seed: int = 0
    """Seed of the synthetic scene."""
    torch: bool = False
    """Measure the reference in torch, too: seconds a picture."""


def synthetic_scene(n: int, seed: int) -> Gaussians:
    """A box full of Gaussians that are a few pixels wide at the sizes measured, log-normally distributed."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    z = 2 + 8 * torch.rand(n, 1, generator=generator)
    xy = (2 * torch.rand(n, 2, generator=generator) - 1) * z * torch.tensor([0.7, 0.5])
    scales = 0.6 * normal(n, 3) + (0.008 * z).log()
    features_rest, opacities = 0.1 * normal(n, 15, 3), 1.5 * normal(n, 1)
    return Gaussians(torch.cat((xy, z), dim=1), scales, normal(n, 4), normal(n, 3), features_rest, opacities)


def camera(width: int) -> View:
    """In front of the scene, 62 degrees wide."""
    height, focal = 2 * width // 3, width / 1.2
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return View(torch.eye(4), K, width, height)


def take_turns(sides: Sides, rounds: int) -> dict[str, float]:
    """Median milliseconds of each side; they run one after the other in every round."""
    times: dict[str, list[float]] = {name: [] for name in sides}
    for _ in range(WARM + rounds):
        for name, run in sides.items():
            started = time.perf_counter()
            run()
            times[name].append(1e3 * (time.perf_counter() - started))
    return {name: statistics.median(values[WARM:]) for name, values in times.items()}


def sides_of(name: str, rasterizer: TorchRasterizer, gaussians: Gaussians, view: View) -> Sides:
    """Drawing without gradients, and with."""
    leaves = Gaussians(**{key: value.clone().requires_grad_() for key, value in gaussians.items()})

    def forward() -> None:
        with torch.no_grad():
            rasterizer(gaussians, view, sh_degree=3)

    def both() -> None:
        raster = rasterizer(leaves, view, sh_degree=3)
        ((raster.color - 0.5).square().mean() + raster.depth.mean() + raster.transmittance.mean()).backward()

    return {f"{name}, forward": forward, f"{name}, forward + backward": both}


def main(args: Args) -> None:
    """Print a table."""
    print_machine(f"seed {args.seed}, {args.gaussians:,} Gaussians; ms a picture\n")
    gaussians, native = synthetic_scene(args.gaussians, args.seed), TorchRasterizer()
    native.warm_up()
    columns = []
    for view in map(camera, args.widths):
        sides = sides_of("native", native, gaussians, view)
        sides |= sides_of("torch", TorchRasterizer(use_native=False), gaussians, view) if args.torch else {}
        columns.append(take_turns(sides, args.rounds))
    names = [f"{width}x{2 * width // 3}" for width in args.widths]
    rows = [[side, *(f"{column[side]:.1f}" for column in columns)] for side in columns[0]]
    print(markdown([["", *names], *rows]))


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
