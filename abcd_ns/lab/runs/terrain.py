"""One run on a synthetic terrain in a process of its own: `python -m abcd_ns.lab.runs.terrain JOB.json`."""

import math
import sys
import time
from pathlib import Path
from statistics import fmean

import psutil
import torch

from abcd_ns.engine.events import Event, StepTaken, VisitEnded
from abcd_ns.engine.gaussians.block_state import BlockState
from abcd_ns.engine.gaussians.param_swap import nothing_live
from abcd_ns.engine.render import loss, make_rasterizer
from abcd_ns.engine.space.partition import build_kd
from abcd_ns.engine.store import ParameterStore
from abcd_ns.engine.store.scene import StoredScene
from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.train.coordinator import Coordinator
from abcd_ns.engine.train.density.control import DensityConfig
from abcd_ns.engine.train.recipe import Limits, Recipe
from abcd_ns.engine.train.run import TrainingRun
from abcd_ns.engine.train.run_state import Budget
from abcd_ns.engine.train.training_loop import train_step
from abcd_ns.engine.types import Gaussians
from abcd_ns.lab.job import TerrainJob
from abcd_ns.lab.results.run import Footing, Run
from abcd_ns.lab.runs.runner import memory_of_run, work
from abcd_ns.lab.world.land import Land
from abcd_ns.machine import describe_versions, disk_bytes, peak_rss_bytes
from abcd_ns.nerfstudio.run import STORE

WHOLE_STEPS = 12
"""Enough for Adam's moments and the drawing of the largest view to be there."""


def run(job: TerrainJob, folder: Path) -> Run:
    """Make the scene on disk, train some visits, and say what they took."""
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if job.settings.device_limit_bytes and device.type == "cuda":
        share = job.settings.device_limit_bytes / torch.cuda.get_device_properties(device).total_memory
        torch.cuda.set_per_process_memory_fraction(min(share, 1.0), torch.cuda.current_device())
    rasterizer = make_rasterizer("auto", device)
    rasterizer.warm_up()
    loss.warm_up(device)
    base, began = peak_rss_bytes(), time.perf_counter()
    land = Land(job.value, job.settings.gaussians, seed=job.seed)
    scene = make_scene(job, land, folder / STORE)
    made = time.perf_counter()
    coordinator = _coordinator(job, land, scene, rasterizer, device)
    watch = _Watch(coordinator)
    cameras = {view.index: view for view in land.cameras()}
    # The visit to a single block lasts as long as the run.
    wanted = WHOLE_STEPS if scene.tree.num_blocks == 1 else None
    while len(watch.visits) < job.settings.visits if wanted is None else coordinator.state.step < wanted:
        train_step(coordinator, lambda view, crop: land.crop(cameras[view], crop))
    memory = memory_of_run()
    coordinator.close()
    visits = watch.visits[1:] or watch.visits  # the first one's time holds the planning of the sweep
    footing = Footing(
        base_rss_bytes=base,
        make_seconds=made - began,
        plan_seconds=watch.first_step - made,
        visit_seconds=fmean(v.seconds for v in visits) if visits else None,
        layer_seconds=fmean(v.layer_seconds for v in visits) if visits else None,
    )
    return Run(
        method=job.method,
        scene="terrain",
        seed=job.seed,
        blocks=scene.tree.num_blocks,
        steps=coordinator.state.step,
        train_seconds=time.perf_counter() - made,
        total_seconds=time.time() - psutil.Process().create_time(),
        **dict.fromkeys(("ssim", "lpips", "psnr_merged", "ssim_merged", "ordering_gap_db")),
        psnr=fmean(watch.psnr),
        lpips_reason="nothing is held out",
        ordering_gap_note="nothing is held out",
        gaussians=job.value * job.settings.gaussians,
        **memory,
        store_bytes=disk_bytes(folder / STORE),
        layer_seconds=sum(visit.layer_seconds for visit in watch.visits),
        curve=(),
        views=(),
        versions=describe_versions(),
        memory=footing,
    )


def make_scene(job: TerrainJob, land: Land, folder: Path) -> StoredScene:
    """The land at rest: tile by tile, or all tiles as one block, which takes the RAM that it takes."""
    whole = job.method == "abcd-monolithic"
    tree = build_kd(torch.zeros(0, 3), 1) if whole else land.tree()
    store = ParameterStore.create(folder, {"tree": tree.to_json()})
    if whole:
        everything = Gaussians.cat([land.make_tile(tile) for tile in range(land.tiles)])
        store.commit({0: BlockState.fresh(everything).packed()})
    else:
        for block, tile in enumerate(land.tile_of(tree)):
            store.commit({block: BlockState.fresh(land.make_tile(tile)).packed()})
            print(f"tile {block + 1}/{land.tiles}", flush=True)
    return StoredScene(tree, store, ram_bytes=job.settings.ram_budget_bytes)


def _coordinator(job: TerrainJob, land: Land, scene: StoredScene, rasterizer, device) -> Coordinator:
    config = TrainingConfig(
        recipe=Recipe(sh_ramp=0.0),
        # As large blocks have it. Small ones may draw more at once, for speed, which small lands do not have.
        limits=Limits(pass_gaussians=2 * job.settings.gaussians),
        seed=job.seed,
        warmup=0.0,
        background="black",
        density=DensityConfig(strategy="off"),  # or blocks would not be equal
    )
    run = TrainingRun(
        config,
        Budget(steps=10**9),
        scene,
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
                if math.isfinite(event.psnr):  # told a step late, so not of a visit's first
                    self.psnr.append(event.psnr)
            case VisitEnded():
                self.visits.append(event)
                print(f"visit {len(self.visits)}: {event.seconds:.1f} s", flush=True)


if __name__ == "__main__":
    sys.exit(work(TerrainJob, run))
