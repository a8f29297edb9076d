"""All that is to be measured on a CUDA device, part by part.

    timeout 40m python -m benchmarks.gpu --data DIR --out OUT

OUT gets a JSON file for each part and charts. A file is written whenever its part finds something, so what is
interrupted leaves what it had. A part that is there and whole is not run again.
"""

import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import datetime, timezone
from functools import partial
from pathlib import Path
from shutil import rmtree
from typing import Any, Literal, get_args

import torch
import tyro
from rich.console import Console

from abcd_ns.cli.report.run_folder import CHECKPOINTS
from abcd_ns.engine.render import make_rasterizer, self_check
from abcd_ns.errors import UserError
from abcd_ns.lab.compare.charts import draw_charts
from abcd_ns.lab.compare.command import Options, make_plan, terrain_jobs
from abcd_ns.lab.job import Job, Plan, TerrainSettings
from abcd_ns.lab.results.records import decode, read_json, write_json
from abcd_ns.lab.results.results import TERRAIN, Results
from abcd_ns.lab.results.tables import notes, print_rows, rows
from abcd_ns.lab.runs.runner import run_jobs
from abcd_ns.machine import describe_machine, describe_versions
from abcd_ns.run import STATE
from abcd_ns.units import MIB
from benchmarks import visit
from benchmarks.runs import read_stage

OUT = Path("docs/results/gpu")
Found = dict[str, Any]
Part = Literal["build", "compare", "compare-steps", "extent", "visit"]


@dataclass
class Args:
    """What to do."""

    data: Path | None = None
    """The scene, as for `ns-train abcd --data`, at full size."""
    out: Path | None = None
    """Gets a JSON file a part, and charts; OUT/work is scratch. Default: docs/results/gpu; of a dry run, a
    temporary folder."""
    parts: tuple[Part, ...] = get_args(Part)
    """In this order."""
    again: bool = False
    """Run these parts whether or not their files are there, from nothing."""
    dry_run: bool = False
    """Try the machinery where there is no CUDA device: tiny, on the CPU. Its numbers mean nothing."""
    seed: int = 0
    """Of every run."""

    @property
    def size(self) -> "Size":
        return TINY if self.dry_run else Size()


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
class ScoredJob(Job):
    """A run of which nothing is wanted but its scores."""

    scratch = (STATE, CHECKPOINTS)  # stored blocks, layers, checkpoints: gigabytes


def build(_args: Args, _work: Path) -> Iterator[Found]:
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


def compare(args: Args, work: Path, by_steps: bool) -> Iterator[Found]:
    """Every method on the scene, under the protocol of `abcd compare`, at equal time or at equal steps."""
    size = args.size
    budget = {"steps": size.steps} if by_steps else {"seconds": size.seconds}
    scene, seeds = str(args.data.resolve()), (args.seed,)
    options = Options(data=scene, out=str(work), methods=size.methods, seeds=seeds, evals=6, pictures=0)
    plan = make_plan(replace(options, **budget))
    arms = [(job.method, ()) for job in plan.jobs]
    arms += [("abcd", (f"blocks={count}",)) for count in size.blocks]
    jobs = tuple(ScoredJob(method, args.seed, plan.settings, changes) for method, changes in arms)
    plan = replace(plan, kind="GPU comparison", jobs=jobs)
    for results in run_jobs(plan, Console()):
        yield {"results": asdict(results)}


def extent(args: Args, work: Path) -> Iterator[Found]:
    """As `abcd compare --tiles`, by blocks and as one, within a limit of GPU memory."""
    size = args.size
    settings = TerrainSettings(size.gaussians, 3, device_limit_bytes=size.device_limit_mb * MIB)
    jobs = terrain_jobs(settings, size.tiles, ("abcd", "abcd-monolithic"), (args.seed,))
    plan = Plan(TERRAIN, settings, work, jobs, "python -m benchmarks.gpu --parts extent")
    for results in run_jobs(plan, Console()):
        yield {"results": asdict(results), "device_limit_bytes": size.device_limit_mb * MIB}


def visits(args: Args, work: Path) -> Iterator[Found]:
    """Where a visit's time goes, by stage and by kernel."""
    size = args.size
    given = visit.Args(args.data.resolve(), seconds=size.visit_seconds, seed=args.seed)
    capture = read_stage(given.data, given.downscale)
    found: Found = {"scene": given.data.name, "seconds": given.seconds, "by_blocks": []}
    for blocks in size.visit_blocks:
        with tempfile.TemporaryDirectory(dir=work) as folder:
            views, spent, rows = visit.run(capture, blocks, given, Path(folder), size.profiled_steps)
        stages = {"views": views, "ms_per_view": spent, "profile": rows}
        found["by_blocks"].append({"blocks": blocks, **stages})
        yield found


PARTS: dict[str, Callable[[Args, Path], Iterator[Found]]] = {
    "build": build,
    "compare": partial(compare, by_steps=False),
    "compare-steps": partial(compare, by_steps=True),
    "extent": extent,
    "visit": visits,
}
NEED_DATA = {"compare", "compare-steps", "visit"}


def main(args: Args) -> int:
    """Run what is missing; 2 without a CUDA device."""
    if not (torch.cuda.is_available() or args.dry_run):
        print("There is no CUDA device here; --dry-run tries the machinery without one.")
        return 2
    out = args.out or (Path(tempfile.mkdtemp(prefix="gpu-dry-run-")) if args.dry_run else OUT)
    if args.data is None and NEED_DATA & set(args.parts):
        raise UserError(f"Give the scene with --data DIR, or --parts without {', '.join(sorted(NEED_DATA))}.")
    for part in args.parts:
        path = out / f"{part}.json"
        kept = read_json(path) if path.exists() and not args.again else {"error": "absent"}
        if kept["error"] or kept["dry_run"] != args.dry_run:
            run_part(part, args, out)
        else:
            print(f"{part}: {path} is there; --again runs it again", flush=True)
    show([read_json(out / f"{part}.json") for part in args.parts], out, Console())
    return 0


def run_part(part: str, args: Args, out: Path) -> None:
    """Run a part; all that it has found so far is always in OUT/PART.json."""
    work, began = out.resolve() / "work" / part, time.monotonic()
    if args.again:
        rmtree(work, ignore_errors=True)
    work.mkdir(parents=True, exist_ok=True)
    date = datetime.now(timezone.utc).isoformat(timespec="seconds")
    record = {"part": part, "dry_run": args.dry_run, "error": "unfinished", "found": {}, "date": date}
    record |= {"machine": asdict(describe_machine()), "versions": asdict(describe_versions())}
    write_json(out / f"{part}.json", record)
    for record["found"] in PARTS[part](args, work):
        write_json(out / f"{part}.json", record)
    record |= {"error": None, "seconds": round(time.monotonic() - began, 1)}
    write_json(out / f"{part}.json", record)


def show(records: Sequence[dict[str, Any]], out: Path, console: Console) -> None:
    """Draw the charts of experiments; print a table for each part."""
    for record in records:
        table, remarks = _rows(record["part"], record["found"])
        if (results := _results(record["found"])) is not None:
            remarks += map(str, draw_charts(results, out, f"{record['part']}-"))
        dry = ["a dry run: these numbers mean nothing"] if record["dry_run"] else []
        print_rows(table, [*dry, *remarks], console)


def _rows(part: str, found: dict[str, Any]) -> tuple[list[list[str]], list[str]]:
    """A part's table, titles first, and notes."""
    if not found:
        return [[part]], []
    if (results := _results(found)) is not None:
        return rows(results), [*results.findings, *notes(results)]
    if part == "visit":
        columns = found["by_blocks"]
        titles = ["visit, ms a view", *(f"{column['blocks']} blocks" for column in columns)]
        stages = columns[0]["ms_per_view"] if columns else {}
        body = [[stage, *(f"{column['ms_per_view'][stage]:.2f}" for column in columns)] for stage in stages]
        return [titles, *body], []
    flat = {**found["hardware"], **{name: value for name, value in found.items() if name != "hardware"}}
    return [["build", ""], *([name, str(value)] for name, value in flat.items())], []


def _results(found: dict[str, Any]) -> Results | None:
    """Of a part that is an experiment."""
    return decode(Results, found["results"], "results") if found.get("results") else None


if __name__ == "__main__":
    try:
        sys.exit(main(tyro.cli(Args)))
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
