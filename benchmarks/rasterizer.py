"""How fast the torch rasterizer is on this machine: its kernels against two plainer forms, and whole steps.

    python -m benchmarks.rasterizer

All sides run in one process, taking turns; each figure is the median over the rounds. Compiling, caches and
first touches of memory come before the clock starts.
"""

import os
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
import tyro
from torch import Tensor

from abcd_ns.engine.kernels import can_build
from abcd_ns.engine.render import TorchRasterizer
from abcd_ns.engine.render.cpu import backend
from abcd_ns.engine.render.cpu.binning import bin_splats
from abcd_ns.engine.render.cpu.chunk_kernels import ChunkKernels
from abcd_ns.engine.render.cpu.torch_kernels import (
    ALWAYS,
    BLUE,
    CONIC_XX,
    CONIC_XY,
    CONIC_YY,
    DEPTH,
    GRADED,
    GREEN,
    OPACITY,
    RED,
    X,
    Y,
)
from abcd_ns.engine.render.projection import project
from abcd_ns.engine.render.tile_grid import TileGrid
from abcd_ns.engine.types import Gaussians, View
from benchmarks.runs import print_machine

SIZES = ((160, 106), (320, 213))
TILES = 1080
"""As many tiles of 4 x 4 as 160 x 106 px have. With a power of two all planes would share cache sets."""


@dataclass
class Args:
    """What to measure."""

    gaussians: int = 26_000
    """Number of Gaussians in the synthetic scene."""
    rounds: int = 7
    """Timed rounds per figure; the median is reported."""
    seed: int = 0
    """Seed of the synthetic scene."""
    tile_side: int = backend.TILE_SIDE
    """Pixels along a tile's side."""
    chunk: int = backend.CHUNK
    """Gaussians per kernel call and tile."""
    threads: int = 0
    """CPU threads; 0 leaves torch's choice. On a busy machine, 1 disturbs the figures least."""


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


def camera(width: int, height: int) -> View:
    """In front of the scene, 62 degrees wide."""
    focal = width / 1.2
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return View(torch.eye(4), K, width, height)


def take_turns(sides: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Median milliseconds of each side; they run one after the other in every round."""
    times: dict[str, list[float]] = {name: [] for name in sides}
    for warm in [True] * 2 + [False] * rounds:
        for name, run in sides.items():
            started = time.perf_counter()
            run()
            if not warm:
                times[name].append(1e3 * (time.perf_counter() - started))
    return {name: statistics.median(values) for name, values in times.items()}


def cumprod_chunk(params: Tensor, origins: Tensor, state: Tensor, side: int) -> Tensor:
    """The forward kernel as one would write it first: all lanes at once, transmittance by cumprod."""
    pixel = torch.arange(side * side)
    dx = (params[X] - origins[0])[:, None] - (pixel % side + 0.5)[:, None]
    dy = (params[Y] - origins[1])[:, None] - (pixel // side + 0.5)[:, None]
    half_xx, xy, half_yy = (
        0.5 * params[CONIC_XX, :, None],
        params[CONIC_XY, :, None],
        0.5 * params[CONIC_YY, :, None],
    )
    sigma = half_xx * dx * dx + half_yy * dy * dy + xy * dx * dy
    alpha = (params[OPACITY, :, None] * torch.exp(-sigma)).clamp_max(0.999)
    alpha = torch.where((sigma >= 0) & (alpha >= 1 / 255), alpha, 0.0)
    after = state[0] * torch.cumprod(1 - alpha, dim=0)
    before = torch.cat((state[:1], after[:-1]))
    weights = torch.where(after > 1e-4, alpha * before, 0.0)
    channels = [
        state[plane] + (weights * params[row, :, None]).sum(0)
        for plane, row in enumerate((RED, GREEN, BLUE, DEPTH), start=1)
    ]
    return torch.stack([after[-1], *channels])


def kernel_inputs(args: Args) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """(params, origins, state, upstream) of TILES tiles and one chunk; faint, so that no ray stops."""
    generator = torch.Generator().manual_seed(args.seed)
    params = torch.rand(ALWAYS + 1, args.chunk, TILES, generator=generator)
    params[ALWAYS] = 1
    params[[X, Y]] *= args.tile_side
    params[[CONIC_XX, CONIC_YY]] += 0.2
    params[CONIC_XY] *= 0.1
    params[OPACITY] *= 0.2
    state = torch.zeros(5, args.tile_side**2, TILES)
    state[0] = 1
    return params, torch.zeros(2, TILES), state, torch.rand(5, args.tile_side**2, TILES, generator=generator)


def measure_kernels(args: Args) -> None:
    params, origins, state, upstream = kernel_inputs(args)
    leaf, side, window = params.clone().requires_grad_(), args.tile_side, state[:2]
    forward: dict[str, Callable[[], object]] = {
        "eager cumprod": lambda: cumprod_chunk(params, origins, state, side)
    }

    def cumprod_both() -> None:
        (cumprod_chunk(leaf, origins, state, side) * upstream).sum().backward()

    both: dict[str, Callable[[], object]] = {"eager cumprod": cumprod_both}
    for name, policy in (("eager loop", "never"), ("built loop", "always")):
        if policy == "always" and not can_build():
            continue
        kernels = ChunkKernels(policy, side, args.chunk)

        def run_forward(kernels: ChunkKernels = kernels) -> None:
            kernels.forward(params, origins, state, window)

        def run_both(kernels: ChunkKernels = kernels, forward: Callable[[], None] = run_forward) -> None:
            forward()
            kernels.backward(params, origins, state, upstream, window)

        forward[name], both[name] = run_forward, run_both
    pairs = TILES * side**2 * args.chunk
    with torch.no_grad():
        forward_ms = take_turns(forward, args.rounds)
    both_ms = take_turns(both, args.rounds)
    print(f"\n## Kernels: {TILES} tiles of {side}x{side} px, {args.chunk} Gaussians; ns per pixel-Gaussian\n")
    print("| form | forward | forward + backward |\n| --- | --- | --- |")
    for name in forward:
        print(f"| {name} | {1e6 * forward_ms[name] / pairs:.2f} | {1e6 * both_ms[name] / pairs:.2f} |")


def as_leaves(gaussians: Gaussians) -> Gaussians:
    return Gaussians(**{name: value.clone().requires_grad_() for name, value in gaussians.items()})


def step_sides(
    rasterizer: TorchRasterizer, gaussians: Gaussians, view: View
) -> dict[str, Callable[[], object]]:
    leaves = as_leaves(gaussians)

    def forward() -> None:
        with torch.no_grad():
            rasterizer(gaussians, view, sh_degree=3)

    def both() -> None:
        raster = rasterizer(leaves, view, sh_degree=3)
        ((raster.color - 0.5).square().mean() + raster.depth.mean() + raster.transmittance.mean()).backward()

    return {"forward": forward, "forward + backward": both}


def part_sides(args: Args, gaussians: Gaussians, view: View) -> dict[str, Callable[[], object]]:
    """The parts of a step around the chunk kernels."""
    leaves, grid = as_leaves(gaussians), TileGrid(view.full, args.tile_side)
    with torch.no_grad():
        splats = project(gaussians, view)

    def projection(built: bool) -> None:
        (project(leaves, view, sh_degree=3, built=built).planes[:GRADED].sum()).backward()

    return {
        "projection and colours, both ways, eager": lambda: projection(False),
        "projection and colours, both ways, built": lambda: projection(True),
        "binning and sorting": lambda: bin_splats(splats, grid, args.chunk),
    }


def measure_steps(args: Args, width: int, height: int) -> None:
    gaussians, view = synthetic_scene(args.gaussians, args.seed), camera(width, height)
    with torch.no_grad():
        splats = project(gaussians, view)
    lists = bin_splats(splats, TileGrid(view.full, args.tile_side), args.chunk)
    sides = part_sides(args, gaussians, view)
    policies = ["never", "always"] if can_build() else ["never"]
    for policy in policies:
        rasterizer = TorchRasterizer(policy, tile_side=args.tile_side, chunk=args.chunk)
        label = {"never": "eager", "always": "built"}[policy]
        sides |= {f"{label}: {name}": run for name, run in step_sides(rasterizer, gaussians, view).items()}
    print(f"\n## Steps: {width}x{height}, {args.gaussians} Gaussians, ms\n")
    visible = splats.radii > 0
    radius = float(splats.radii[visible].float().median())
    print(
        f"{int(visible.sum())} visible, median radius {radius:.0f} px, {lists.fragments / 1e6:.2f} M pairs\n"
    )
    print("| part | ms |\n| --- | --- |")
    for name, ms in take_turns(sides, args.rounds).items():
        print(f"| {name} | {ms:.1f} |")


def main(args: Args) -> None:
    """Print all tables as Markdown."""
    if args.threads > 0:
        torch.set_num_threads(args.threads)
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
    print_machine(f"seed {args.seed}", f"load average at the start {load:.1f}")
    measure_kernels(args)
    for width, height in SIZES:
        measure_steps(args, width, height)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
