"""What a visit by a worker costs the driver, and how many workers that leaves it time for.

    python -m benchmarks.driver --gaussians 1000000

One block of so many random Gaussians: read and copied to be lent, its answer settled by cells and put to rest
on disk, all of it one after the other. Ray's own work is left out. Nothing is drawn, and nothing is trained.
"""

import tempfile
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro

from abcd_ns.engine.space.partition import build_kd
from abcd_ns.engine.store import ParameterStore
from abcd_ns.engine.store.scaffold import blocks_at_rest
from abcd_ns.engine.store.scene import StoredScene
from abcd_ns.engine.store.settle import settle, state_for_visit
from abcd_ns.engine.types import Gaussians
from abcd_ns.machine import describe_machine
from benchmarks.runs import StageClock

BLOCKS = 2
NEIGHBOURS = 8
"""Changed blocks that a worker is sent for a visit: those that its views show, supposed."""


@dataclass
class Args:
    """What to measure."""

    gaussians: int = 1_000_000
    """Of a block."""
    visits: int = 3
    """To measure; the mean is told."""
    visit_seconds: float = 60.0
    """That a worker takes for a visit, supposed."""


def measure(args: Args, folder: Path) -> tuple[dict[str, float], int, int]:
    """Seconds a visit by stage; bytes of the block with its moments, and as it is drawn."""
    generator = torch.Generator().manual_seed(0)
    empty = Gaussians.empty()
    start = Gaussians(
        **{
            n: torch.randn((BLOCKS * args.gaussians, *v.shape[1:]), generator=generator)
            for n, v in empty.items()
        }
    )
    tree = build_kd(start.means, BLOCKS)
    store = ParameterStore.create(folder / "store", {"tree": tree.to_json()})
    store.commit(blocks_at_rest(tree, start))
    scene, clock = StoredScene(tree, store), StageClock()
    for _ in range(args.visits):
        with clock.stage("reading, and a copy to lend"):
            state = state_for_visit(scene, 0)
            lent = {name: tensor.clone() for name, tensor in state.packed()[0].items()}
        with clock.stage("settling the answer by cells"):
            updates = settle(scene, 0, state)
        with clock.stage("putting it to rest on disk"):
            scene.rest(tree, updates, {}, 0.0)
            scene.flush()
    scene.close()
    moved = sum(tensor.nbytes for tensor in lent.values())
    return {name: value / args.visits for name, value in clock.seconds.items()}, moved, state.gaussians.nbytes


def main(args: Args) -> None:
    """Print a table, and what each resource has room for."""
    with tempfile.TemporaryDirectory() as folder:
        seconds, block, drawn = measure(args, Path(folder))
    machine = describe_machine()
    print(f"{machine.cpu}, {machine.cores} cores; a block of {args.gaussians:,} Gaussians\n")
    print("| for each visit | |\n| --- | ---: |")
    for name, value in seconds.items():
        print(f"| {name} | {value:.2f} s |")
    print(f"| to the worker and back | {2 * block / 1e6:,.0f} MB |")
    print(f"| each block around it, once in each version | {drawn / 1e6:,.0f} MB |\n")
    print(f"Workers whose visits take {args.visit_seconds:g} s, that each could serve:\n")
    print("| | workers |\n| --- | ---: |")
    print(f"| driver, one thread | {args.visit_seconds / sum(seconds.values()):,.0f} |")
    for name, (rate, nbytes) in limits(block, drawn).items():
        print(f"| {name} | {args.visit_seconds * rate / nbytes:,.0f} |")


def limits(block: int, drawn: int) -> dict[str, tuple[float, int]]:
    """By resource its bytes a second, and what a visit asks of it. On the network go the block, its answer,
    and NEIGHBOURS others that have changed; the driver's disk gets the answer."""
    sent = 2 * block + NEIGHBOURS * drawn
    return {
        "the driver's disk, 1 GB/s": (1e9, block),
        "the driver's network, 10 Gbit/s": (1.25e9, sent),
        "the driver's network, 100 Gbit/s": (12.5e9, sent),
    }


if __name__ == "__main__":
    main(tyro.cli(Args))
