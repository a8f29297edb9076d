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
from abcd_ns.engine.gaussians.param_swap import nothing_active
from abcd_ns.engine.render import Rasterizer, loss, make_rasterizer
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
from abcd_ns.lab.results.results import Footing, Run
from abcd_ns.lab.runs.runner import memory_of_run, work
from abcd_ns.lab.world.land import Land
from abcd_ns.machine import describe_versions, disk_bytes, peak_rss_bytes
from abcd_ns.run import STORE

RAM_BYTES = 16 << 20  # for blocks that were read, smaller than any scene; layers and photos have their own
WHOLE_STEPS = 12  # enough for Adam's moments and the drawing of the largest view to be there


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
    steps, visits = _train(coordinator, land, job.settings.visits)
    memory = memory_of_run()
    coordinator.close()
    last = [e.psnr for _, e in steps if e.visit == steps[-1][1].visit and math.isfinite(e.psnr)]
    usual = visits[1:] or visits  # the first one's time holds the planning of the epoch
    return Run(
        method=job.method,
        scene="terrain",
        seed=job.seed,
        blocks=scene.tree.num_blocks,
        steps=coordinator.state.step,
        train_seconds=time.perf_counter() - made,
        total_seconds=time.time() - psutil.Process().create_time(),
        **dict.fromkeys(("ssim", "lpips", "psnr_merged", "ssim_merged", "ordering_gap_db")),
        psnr=fmean(last),
        lpips_reason="nothing is held out",
        ordering_gap_note="nothing is held out",
        gaussians=job.value * job.settings.gaussians,
        **memory,
        store_bytes=disk_bytes(folder / STORE),
        layer_seconds=sum(visit.layer_seconds for visit in visits),
        curve=(),
        views=(),
        versions=describe_versions(),
        memory=Footing(
            base_rss_bytes=base,
            make_seconds=made - began,
            plan_seconds=steps[0][0] - made,
            visit_seconds=fmean(visit.visit_seconds for visit in usual) if usual else None,
            layer_seconds=fmean(visit.layer_seconds for visit in usual) if usual else None,
        ),
    )


def make_scene(job: TerrainJob, land: Land, folder: Path) -> StoredScene:
    """The land, stored tile by tile, or all tiles as one block, which takes the RAM that it takes."""
    whole, tiles = job.method == "abcd-monolithic", range(land.tiles)
    tree = build_kd(torch.zeros(0, 3), 1) if whole else land.tree()
    store = ParameterStore.create(folder, {"tree": tree.to_json()})
    blocks = {0: tiles} if whole else {b: [t] for t, b in enumerate(tree.assign(land.middles).tolist())}
    for block, own in blocks.items():
        gaussians = Gaussians.cat([land.make_tile(tile) for tile in own])
        store.commit({block: BlockState.fresh(gaussians).packed()})
    return StoredScene(tree, store, RAM_BYTES)


def _coordinator(
    job: TerrainJob, land: Land, scene: StoredScene, rasterizer: Rasterizer, device: torch.device
) -> Coordinator:
    config = TrainingConfig(
        recipe=Recipe(sh_ramp=0.0),
        # As large blocks have it. Small ones may draw more at once, for speed, which small lands do not have.
        limits=Limits(pass_gaussians=2 * job.settings.gaussians),
        seed=job.seed,
        warmup=0.0,
        background="black",
        density=DensityConfig(strategy="off"),  # or blocks would not be equal
    )
    empty, budget = nothing_active(3, device), Budget(steps=10**9)
    return Coordinator(TrainingRun(config, budget, scene, land.cameras(), rasterizer, *empty, device=device))


def _train(
    coordinator: Coordinator, land: Land, wanted: int
) -> tuple[list[tuple[float, StepTaken]], list[VisitEnded]]:
    """Train `wanted` visits; the steps, with the time of each, and the visits that ended."""
    steps: list[tuple[float, StepTaken]] = []
    visits: list[VisitEnded] = []

    def listen(event: Event) -> None:
        if isinstance(event, StepTaken):
            steps.append((time.perf_counter(), event))
        if isinstance(event, VisitEnded):
            visits.append(event)

    coordinator.announce.subscribe(listen)
    cameras = {view.index: view for view in land.cameras()}
    # The visit to a single block lasts as long as the run.
    whole = coordinator.scene.tree.num_blocks == 1
    while coordinator.state.step < WHOLE_STEPS if whole else len(visits) < wanted:
        train_step(coordinator, lambda view, crop: land.crop(cameras[view], crop))
    return steps, visits


if __name__ == "__main__":
    sys.exit(work(TerrainJob, run))
