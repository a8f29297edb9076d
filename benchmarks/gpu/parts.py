"""The parts of the GPU benchmark, each in a process of its own: `python -m benchmarks.gpu.parts TASK.json`.

A part is a generator: each record it yields holds all that it has found so far and is written at once, so
that a part that is killed leaves what it had.
"""

import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from abcd_ns.cli.report.run_folder import CHECKPOINTS
from abcd_ns.engine.render import make_rasterizer, self_check
from abcd_ns.lab.compare.command import Options, make_plan, terrain_jobs
from abcd_ns.lab.job import Job, Plan, TerrainSettings
from abcd_ns.lab.results.records import decode, encode, read_json, write_json
from abcd_ns.lab.results.results import TERRAIN
from abcd_ns.lab.runs.runner import run_jobs
from abcd_ns.machine import describe_machine, describe_versions
from abcd_ns.run import STATE
from abcd_ns.units import MIB
from benchmarks import visit
from benchmarks.runs import read_stage

ROOT = Path(__file__).resolve().parents[2]
Found = dict[str, Any]


@dataclass(frozen=True)
class Size:
    """How much is done; one for a GPU, and one that tries the machinery on a CPU."""

    methods: tuple[str, ...] = ("splatfacto", "abcd-monolithic", "abcd-ablated")
    blocks: tuple[int, ...] = (1, 8, 27)
    """Of `abcd`, a run each; the others with any have 8."""
    seconds: float = 60.0
    """Of training, in the comparison at equal time."""
    steps: int = 1000
    """In the one at equal steps."""
    tiles: tuple[int, ...] = (1, 2, 4, 8, 16, 32, 64)
    gaussians: int = 100_000
    """In each tile."""
    device_limit_mb: int = 4096
    """GPU memory while the extent grows: a large card would need a larger land than there is time to make."""
    visit_blocks: tuple[int, ...] = (1, 8)
    visit_seconds: float = 30.0
    profiled_steps: int = 20


TINY = Size(("splatfacto",), (2,), 2.0, 4, (2,), 200, 0, (2,), 2.0, 2)


@dataclass(frozen=True)
class Task:
    """What a part is given."""

    part: str
    out: str
    """Gets PART.json."""
    work: str
    """Scratch of this part alone; what is finished there is not done again."""
    data: str | None
    seed: int
    tiny: bool

    @property
    def size(self) -> Size:
        return TINY if self.tiny else Size()


@dataclass(frozen=True)
class ScoredJob(Job):
    """A run of which nothing is wanted but its scores."""

    scratch = (STATE, CHECKPOINTS)  # blocks at rest, layers, checkpoints: gigabytes


def build(_: Task) -> Iterator[Found]:
    """gsplat's extension, compiled if need be; whether the rasterizers compute what they should."""
    found: Found = {"hardware": asdict(describe_machine())}
    yield found
    device, began = "cuda" if torch.cuda.is_available() else "cpu", time.perf_counter()
    rasterizer = make_rasterizer("auto", device)
    found |= {"rasterizer": rasterizer.name, "ready_seconds": time.perf_counter() - began}
    found["self_check"] = self_check(rasterizer, device)
    yield found
    surfels = make_rasterizer("auto", device, primitive="2dgs")
    yield found | {"self_check_2dgs": self_check(surfels, device)}


def compare(task: Task, by_steps: bool) -> Iterator[Found]:
    """Every method on the scene, under the protocol of `abcd compare`, at equal time or at equal steps."""
    size = task.size
    budget = {"steps": size.steps} if by_steps else {"seconds": size.seconds}
    shared = {"data": task.data, "out": task.work, "seeds": (task.seed,), "evals": 6, "pictures": 0}
    plan = make_plan(Options(methods=size.methods, **shared, **budget))
    arms = [(job.method, ()) for job in plan.jobs]
    arms += [("abcd", (f"blocks={count}",)) for count in size.blocks]
    jobs = tuple(ScoredJob(method, task.seed, plan.settings, changes) for method, changes in arms)
    plan = replace(plan, kind="GPU comparison", jobs=jobs)
    for results in run_jobs(plan, Console()):
        yield {"results": encode(results)}


def extent(task: Task) -> Iterator[Found]:
    """As `abcd compare --tiles`, by blocks and as one, within a limit of GPU memory."""
    size = task.size
    settings = TerrainSettings(size.gaussians, 3, device_limit_bytes=size.device_limit_mb * MIB)
    jobs = terrain_jobs(settings, size.tiles, ("abcd", "abcd-monolithic"), (task.seed,))
    plan = Plan(TERRAIN, settings, Path(task.work), jobs, "python -m benchmarks.gpu --parts extent")
    for results in run_jobs(plan, Console()):
        yield {"results": encode(results), "device_limit_bytes": size.device_limit_mb * MIB}


def visits(task: Task) -> Iterator[Found]:
    """Where a visit's time goes, by stage and by kernel."""
    size = task.size
    args = visit.Args(Path(task.data), seconds=size.visit_seconds, seed=task.seed)
    capture = read_stage(args.data, args.downscale)
    found: Found = {"scene": args.data.name, "seconds": args.seconds, "by_blocks": []}
    for blocks in size.visit_blocks:
        rows: list[Found] = []

        def look(coordinator, rows=rows) -> None:
            rows += visit.profile(coordinator, capture, size.profiled_steps)

        with tempfile.TemporaryDirectory(dir=task.work) as folder:
            views, spent = visit.run(capture, blocks, args, Path(folder), look)
        stages = {"views": views, "ms_per_view": spent, "profile": rows}
        found["by_blocks"].append({"blocks": blocks, **stages})
        yield found


PARTS: dict[str, tuple[float, Callable[[Task], Iterator[Found]]]] = {
    "build": (4, build),
    "compare": (11, partial(compare, by_steps=False)),
    "compare-steps": (10, partial(compare, by_steps=True)),
    "extent": (7, extent),
    "visit": (4, visits),
}
"""Each part's share of the minutes, and what it does."""
NEED_DATA = {"compare", "compare-steps", "visit"}


def main() -> None:
    """Do the task in the file that is the only argument."""
    (path,) = map(Path, sys.argv[1:])
    task = decode(Task, read_json(path), str(path))
    about = {"part": task.part, "dry_run": task.tiny, "machine": asdict(describe_machine())}
    about["versions"] = asdict(describe_versions())
    for found in PARTS[task.part][1](task):
        write_json(Path(task.out) / f"{task.part}.json", {**about, "error": "unfinished", "found": found})


if __name__ == "__main__":
    main()
