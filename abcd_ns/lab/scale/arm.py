"""One measurement in a process of its own: `python -m abcd_ns.lab.scale.arm JOB.json`."""

import sys
import time
from dataclasses import dataclass
from pathlib import Path

import torch

from abcd_ns.engine.events import Event, StepTaken, VisitEnded
from abcd_ns.engine.gaussians.block_state import BlockState
from abcd_ns.engine.gaussians.param_swap import nothing_live
from abcd_ns.engine.render import make_rasterizer
from abcd_ns.engine.space.partition import build_kd
from abcd_ns.engine.store import ParameterStore
from abcd_ns.engine.store.scene import StoredScene
from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.train.coordinator import Coordinator
from abcd_ns.engine.train.density.control import DensityConfig
from abcd_ns.engine.train.recipe import Limits, Recipe
from abcd_ns.engine.train.run import Run
from abcd_ns.engine.train.run_state import Budget
from abcd_ns.engine.train.training_loop import train_step
from abcd_ns.engine.types import Gaussians
from abcd_ns.lab.runs.records import decode, encode, read_json, write_json
from abcd_ns.lab.scale.land import Land
from abcd_ns.nerfstudio.machine import disk_bytes, peak_device_bytes, peak_rss_bytes

RESULT_FILE = "arm.json"
MONOLITHIC_STEPS = 12
"""Enough for Adam's moments and the drawing of the largest view to be there."""


@dataclass(frozen=True)
class ArmJob:
    """What to measure."""

    tiles: int
    gaussians_per_tile: int
    monolithic: bool
    visits: int
    """Visits to make, or with `monolithic` none."""
    ram_budget_bytes: int
    """For blocks that were read; layers and photos have their own."""
    seed: int
    device_limit_bytes: int = 0
    """GPU memory that may be taken, as if the card had no more; 0 for all of it."""


@dataclass(frozen=True)
class Arm:
    """What was measured."""

    tiles: int
    gaussians: int
    """In the whole scene."""
    monolithic: bool
    base_rss_bytes: int
    """RAM before the scene was made: Python, torch and the kernels."""
    peak_rss_bytes: int
    peak_device_bytes: int | None
    store_bytes: int
    make_seconds: float
    plan_seconds: float
    """Until the first visit began: which views see which block."""
    visit_seconds: float | None
    """Mean of the visits but the first, whose time holds `plan_seconds`."""
    layer_seconds: float | None
    """Of it, for layers."""
    steps: int
    psnr: float
    """On the crops trained on, mean of the last visit's steps, dB."""
    peak_reserved_bytes: int | None = None
    """What torch took from the GPU for `peak_device_bytes`; None in results of versions that did not ask."""


def run(job: ArmJob, folder: Path) -> Arm:
    """Make the scene on disk, train some visits, and say what they took."""
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if job.device_limit_bytes and device.type == "cuda":
        share = job.device_limit_bytes / torch.cuda.get_device_properties(device).total_memory
        torch.cuda.set_per_process_memory_fraction(min(share, 1.0), torch.cuda.current_device())
    rasterizer = make_rasterizer("auto", device)
    rasterizer.warm_up()
    base, began = peak_rss_bytes(), time.perf_counter()
    land = Land(job.tiles, job.gaussians_per_tile, seed=job.seed)
    store = make_store(land, job.monolithic, folder / "store")
    made = time.perf_counter()
    coordinator = _coordinator(job, land, store, rasterizer, device)
    watch = _Watch(coordinator)
    cameras = {view.index: view for view in land.cameras()}
    # The visit to a single block lasts as long as the run.
    wanted = MONOLITHIC_STEPS if job.tiles == 1 or job.monolithic else None
    while len(watch.visits) < job.visits if wanted is None else coordinator.state.step < wanted:
        train_step(coordinator, lambda view, crop: land.photo(cameras[view], crop))
    allocated, reserved = peak_device_bytes()
    coordinator.close()
    visits = watch.visits[1:] or watch.visits  # the first one's time holds the planning of the sweep
    return Arm(
        tiles=job.tiles,
        gaussians=job.tiles * job.gaussians_per_tile,
        monolithic=job.monolithic,
        base_rss_bytes=base,
        peak_rss_bytes=peak_rss_bytes(),
        peak_device_bytes=allocated,
        peak_reserved_bytes=reserved,
        store_bytes=disk_bytes(folder / "store"),
        make_seconds=made - began,
        plan_seconds=watch.first_step - made,
        visit_seconds=sum(v.seconds for v in visits) / len(visits) if visits else None,
        layer_seconds=sum(v.layer_seconds for v in visits) / len(visits) if visits else None,
        steps=coordinator.state.step,
        psnr=sum(watch.psnr) / len(watch.psnr),
    )


def make_store(land: Land, monolithic: bool, folder: Path) -> ParameterStore:
    """The land at rest: tile by tile, or all tiles as one block, which takes the RAM that it takes."""
    if monolithic:
        tree = build_kd(torch.zeros(0, 3), 1)
        store = ParameterStore.create(folder, {"tree": tree.to_json()})
        everything = Gaussians.cat([land.make_tile(tile) for tile in range(land.tiles)])
        store.commit({0: BlockState.fresh(everything).to_tensors()})
        return store
    tree = land.tree()
    store = ParameterStore.create(folder, {"tree": tree.to_json()})
    for block, tile in enumerate(land.tile_of(tree)):
        store.commit({block: BlockState.fresh(land.make_tile(tile)).to_tensors()})
        print(f"tile {block + 1}/{land.tiles}", flush=True)
    return store


def _coordinator(job: ArmJob, land: Land, store: ParameterStore, rasterizer, device) -> Coordinator:
    tree = build_kd(torch.zeros(0, 3), 1) if job.monolithic else land.tree()
    config = TrainingConfig(
        recipe=Recipe(sh_ramp=0.0),
        # As large blocks have it. Small ones may draw more at once, for speed, which small lands do not have.
        limits=Limits(pass_gaussians=2 * job.gaussians_per_tile),
        seed=job.seed,
        warmup=0.0,
        background="black",
        density=DensityConfig(strategy="off"),  # or blocks would not be equal
    )
    run = Run(
        config,
        Budget(steps=10**9),
        StoredScene(tree, store, ram_bytes=job.ram_budget_bytes),
        land.cameras(),
        rasterizer,
        *nothing_live(3, device),
        device=device,
    )
    return Coordinator(run)


class _Watch:
    """Takes note of visits, and of the first step."""

    def __init__(self, coordinator: Coordinator) -> None:
        self.visits: list[VisitEnded] = []
        self.psnr: list[float] = []
        self.first_step = 0.0
        self._visit = 0
        coordinator.announce.subscribe(self)

    def __call__(self, event: Event) -> None:
        match event:
            case StepTaken():
                self.first_step = self.first_step or time.perf_counter()
                if event.visit != self._visit:
                    self._visit, self.psnr = event.visit, []
                self.psnr.append(event.psnr)
            case VisitEnded():
                self.visits.append(event)
                print(f"visit {len(self.visits)}: {event.seconds:.1f} s", flush=True)


def main() -> int:
    """Do the job in the file that is the only argument; the result is written beside it."""
    (path,) = map(Path, sys.argv[1:])
    job = decode(ArmJob, read_json(path), str(path))
    write_json(path.with_name(RESULT_FILE), encode(run(job, path.resolve().parent)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
