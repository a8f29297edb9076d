"""Where the time of a visit goes: a run of several blocks and one of a single block, stage by stage.

    python -m benchmarks.visit --data DIR --downscale 4

Stages are summed over the second half of each run, per view drawn in it. On a CUDA device each stage ends
when the device is done. That makes steps slower: their sum is no training time.
"""

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from torch.profiler import ProfilerActivity

from abcd_ns.engine.gaussians.param_swap import nothing_active
from abcd_ns.engine.render import make_rasterizer
from abcd_ns.engine.render.loss import squared_errors
from abcd_ns.engine.train import visit_training
from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.train.coordinator import Coordinator
from abcd_ns.engine.train.run_state import Budget
from abcd_ns.engine.train.step.layer_source import layers_of_visit
from abcd_ns.engine.train.training_loop import PhotoReader
from abcd_ns.lab.results.tables import markdown
from abcd_ns.lab.stability.lab import Stage
from abcd_ns.run.begin import begin_run
from abcd_ns.run.options import RunOptions
from benchmarks.runs import StageClock, print_machine, read_stage

STAGES = ("plan and attach", "layers", "photos", "render", "loss")
STAGES += ("backward", "optimizers", "density and end of visit", "commit")


@dataclass
class Args:
    """What to measure."""

    data: Path
    """The scene, as for `ns-train abcd --data`."""
    downscale: int = 1
    """Divides the photos' width and height."""
    blocks: int = 8
    """Of the run with several."""
    seconds: float = 30.0
    """Of each run; the first half is not measured."""
    seed: int = 0
    """Of the runs."""


def begin(capture: Stage, blocks: int, args: Args, folder: Path) -> Coordinator:
    """A coordinator at the beginning of a run, on CUDA where there is any; its store in `folder`."""
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    options = RunOptions(TrainingConfig(seed=args.seed), blocks=blocks, workers=1)
    rasterizer, budget = make_rasterizer("auto", device), Budget(seconds=args.seconds)
    empty, store, trained_on = nothing_active(3, device), folder / "store", capture.capture(3)
    return begin_run(options, trained_on, device, store, budget, rasterizer, *empty, say=lambda _: None)


def run(
    capture: Stage, blocks: int, args: Args, folder: Path, profiled_steps: int = 0
) -> tuple[int, dict[str, float], list[dict[str, Any]]]:
    """Train; the views that the second half has drawn, its milliseconds a view by stage, and the profile of
    some more steps."""
    coordinator = begin(capture, blocks, args, folder)
    clock, views = StageClock(), 0
    scene = coordinator.scene
    scene.persist = clock.timed("commit", scene.persist)  # as far as the training waits for it
    visit_training.layers_of_visit = clock.timed("layers", layers_of_visit)
    while not coordinator.finished:
        if coordinator.progress < 0.5:
            clock.seconds.clear()
            views = 0
        views += step(coordinator, capture, clock)
    spent = {stage: 1e3 * clock.seconds[stage] / views for stage in STAGES}
    profiled = profile(coordinator, capture, profiled_steps) if profiled_steps else []
    coordinator.close()
    return views, spent, profiled


def step(coordinator: Coordinator, photo: PhotoReader, clock: StageClock) -> int:
    """training_loop.train_step with a clock; the number of views."""
    with clock.stage("plan and attach"):
        batch = coordinator.next_batch()
    with clock.stage("photos"):
        read = (sample.reduced(photo(sample.view.index, sample.source)) for sample in batch.samples)
        photos = [pixels.to(coordinator.device) for pixels in read]
    with clock.stage("render"):
        rendered = coordinator.render(batch)
    with clock.stage("loss"):
        value = coordinator.loss(batch, rendered.pictures, photos)
    with clock.stage("backward"):
        for optimizer in coordinator.optimizers.values():
            optimizer.zero_grad(set_to_none=True)
        if value.requires_grad:
            value.backward()
    with clock.stage("optimizers"):
        for optimizer in coordinator.optimizers.values():
            optimizer.step()
    with clock.stage("density and end of visit"):
        coordinator.after_step(rendered, squared_errors(rendered.pictures, photos))
    return len(batch.samples)


def profile(coordinator: Coordinator, photo: PhotoReader, steps: int, top: int = 30) -> list[dict[str, Any]]:
    """What torch's profiler sees in some more steps: the operations and kernels that took most time.

    Returns:
        A row for each: name, calls a step, device_ms and host_ms a step, of it alone; the most on the device
        first, or on the host where there is none. CUDA's own calls (launches, copies, waits) are all there.
    """
    activities = [ProfilerActivity.CPU]
    activities += [ProfilerActivity.CUDA] if torch.cuda.is_available() else []
    with torch.profiler.profile(activities=activities) as profiler:
        for _ in range(steps):
            step(coordinator, photo, StageClock())
    rows = [
        {
            "name": event.key,
            "calls": event.count / steps,
            "device_ms": event.self_device_time_total / 1e3 / steps,
            "host_ms": event.self_cpu_time_total / 1e3 / steps,
        }
        for event in profiler.key_averages()
    ]
    rows.sort(key=lambda row: (row["device_ms"], row["host_ms"]), reverse=True)
    return rows[:top] + [row for row in rows[top:] if row["name"].startswith("cuda")]


def main(args: Args) -> None:
    """Run both and print the table."""
    capture = read_stage(args.data, args.downscale)
    with tempfile.TemporaryDirectory() as folder:
        one = run(capture, 1, args, Path(folder) / "one")
        several = run(capture, args.blocks, args, Path(folder) / "several")
    print_machine(f"{args.data.name}, {len(capture.views)} views, {args.seconds:g} s a run; ms a view\n")
    table = [["stage", "1 block", f"{args.blocks} blocks"]]
    for stage in STAGES:
        table.append([stage, *(f"{ms[stage]:.2f}" for _, ms, _ in (one, several))])
    table.append(["all", *(f"{sum(ms.values()):.2f}" for _, ms, _ in (one, several))])
    print(markdown([*table, ["views", *(str(views) for views, *_ in (one, several))]]))


if __name__ == "__main__":
    main(tyro.cli(Args))
