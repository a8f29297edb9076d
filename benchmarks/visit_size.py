"""What a visit costs by the size of its block and pictures: survey, layers, steps, and its end.

    python -m benchmarks.visit_size --gaussians 20000 --width 160
    python -m benchmarks.visit_size --gaussians 1000000 --width 1600 --blocks 4 --steps 4

Four such blocks fit into 24 GB of RAM on a CPU, eight do not. A ball of random Gaussians, seen from a
ring of cameras, cut into blocks; one block is visited, after another one whose visit warms everything up.
Photos are noise: what is measured does not depend on what is learnt. The last lines say what a visit comes
to when it is as long as the program makes it: layers drawn once, and each view used as often as leaves a
tenth of the time for that, by `passes_for_layers`.
"""

import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from torch import Tensor

from abcd_ns.engine.events import VisitBegan
from abcd_ns.engine.render import make_rasterizer
from abcd_ns.engine.train.coordinator import Coordinator
from abcd_ns.engine.train.density.control import DensityConfig
from abcd_ns.engine.train.schedule import passes_for_layers
from abcd_ns.engine.train.training_loop import train_step
from abcd_ns.engine.types import Crop
from benchmarks.runs import StageClock, print_machine
from tests.reference.scenes import make_coordinator, random_gaussians, ring_of_views

STAGES = ("survey", "attach", "layers", "steps", "end")


@dataclass
class Args:
    """What to measure."""

    gaussians: int = 20_000
    """Of each block."""
    blocks: int = 8
    """All of which see each other."""
    width: int = 160
    """Of the pictures; two thirds of it high."""
    views: int = 8
    """That a visit uses."""
    steps: int = 8
    """Of the visit, of 4 views each, or of as many as there are."""
    commits: bool = True
    """Write the block to disk when the visit ends, and wait for that; in training a thread does it."""
    seed: int = 0
    """Of the Gaussians."""


def begin(args: Args, folder: Path) -> tuple[Coordinator, Callable[[int, Crop], Tensor]]:
    """A run of two visits, and its photos."""
    count = args.gaussians * args.blocks
    size = 1.2 * count ** (-1 / 3)  # neighbours touch, whatever their number
    gaussians = random_gaussians(count, seed=args.seed, size=size, sh_degree=3)
    views = ring_of_views(args.views, width=args.width, height=2 * args.width // 3)
    noise = torch.rand(views[0].height, views[0].width, 3, generator=torch.Generator().manual_seed(args.seed))
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    coordinator = make_coordinator(
        folder,
        gaussians,
        views,
        blocks=args.blocks,
        steps=1_000_000,
        kind=Coordinator,
        ram_bytes=16 << 30,
        rasterizer=make_rasterizer("auto", device),
        device=device,
        sh_ramp=0.0,
        visit_steps=args.steps,
        warmup=0.0,
        visit_views=args.views,
        commit_seconds=0.0 if args.commits else 1e9,
        density=DensityConfig(strategy="off"),
    )
    return coordinator, lambda _, crop: noise[crop.slices]


def measure(args: Args, folder: Path) -> tuple[Counter, dict[str, float]]:
    """(seconds by stage, what else is known) of the second visit."""
    coordinator, photo = begin(args, folder)
    clock, events = StageClock(), []
    coordinator.announce.subscribe(
        lambda event: events.append(event) if isinstance(event, VisitBegan) else None
    )
    coordinator.visits.begin = clock.timed("survey", coordinator.visits.begin)
    coordinator.source.draw = clock.timed("layers", coordinator.source.draw)
    coordinator.begin_visit = clock.timed("attach", coordinator.begin_visit)
    coordinator.end_visit = clock.timed("end", coordinator.end_visit)
    take_step = clock.timed("steps", train_step)
    layers = 0
    while coordinator.state.visit < 2 or coordinator.state.active is not None:
        if coordinator.state.visit == 1 and coordinator.state.active is None:
            clock.seconds.clear()
        take_step(coordinator, photo)
        if coordinator.visit.layers is not None:
            layers = coordinator.layer_bytes
    state, drawn = coordinator.state, coordinator.batch * args.steps
    known = {"views": events[-1].views, "drawn": drawn, "layer_bytes": layers}
    known |= {"passes": passes_for_layers(state.trained, state.frozen)}
    coordinator.close()
    return clock.seconds, known


def main(args: Args) -> None:
    """Measure once, and print the table."""
    with tempfile.TemporaryDirectory() as folder:
        seconds, known = measure(args, Path(folder))
    views, drawn, passes = known["views"], known["drawn"], known["passes"]
    each = {stage: seconds[stage] / (drawn if stage == "steps" else views) for stage in STAGES}
    rows = "".join(f"| {stage} | {seconds[stage]:.2f} | {1e3 * each[stage]:.1f} |\n" for stage in STAGES)
    print_machine()
    print(f"{args.blocks} blocks of {args.gaussians:,} Gaussians, {views} views {args.width} px wide\n")
    print("| stage | s | ms a view (steps: a view drawn) |\n| --- | ---: | ---: |\n" + rows)
    around = sum(each[stage] for stage in STAGES if stage != "steps")
    print(f"Layers: {known['layer_bytes'] / views / 2**20:.1f} MiB a view.")
    share = around / (around + passes * each["steps"])
    print(f"Passes by the count of Gaussians: {passes}; all but steps: {share:.1%}")


if __name__ == "__main__":
    main(tyro.cli(Args))
