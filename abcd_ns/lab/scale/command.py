"""`abcd scale`: does memory follow the block and not the scene?"""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from abcd_ns.errors import UserError
from abcd_ns.lab.runs.records import decode, encode, read_json, write_json
from abcd_ns.lab.scale.arm import RESULT_FILE, Arm, ArmJob
from abcd_ns.lab.scale.chart import draw
from abcd_ns.lab.scale.results import SCHEMA, ScaleResults, growth, print_results, write_table
from abcd_ns.nerfstudio.machine import describe_machine, describe_versions

MIB = 2**20
RESULTS_FILE, JOB_FILE, LOG_FILE = "scale.json", "job.json", "log.txt"
BYTES_PER_GAUSSIAN = 3 * 59 * 4
"""On disk: parameters and two moments in float32."""
OUT_OF_MEMORY = re.compile(r"CUDA (error: )?out of memory")
"""How torch and CUDA say it, in the last line of a log."""
MONOLITHIC_LIMIT = 4_000_000
"""Gaussians; larger scenes are not tried as one block unless asked for."""


@dataclass(frozen=True)
class Plan:
    """What to measure, and where to put it."""

    out: Path
    jobs: tuple[ArmJob, ...]


@tyro.conf.configure(tyro.conf.FlagCreatePairsOff)
def scale(
    out: Annotated[Path, tyro.conf.arg(metavar="PATH")],
    blocks: Annotated[tuple[int, ...], tyro.conf.arg(metavar="N ...")] = (2, 4, 8, 16, 32, 64),
    gaussians: Annotated[int, tyro.conf.arg(metavar="N")] = 20_000,
    visits: Annotated[int, tyro.conf.arg(metavar="N")] = 3,
    ram_budget_mb: Annotated[int, tyro.conf.arg(metavar="MB")] = 16,
    monolithic_limit: Annotated[int, tyro.conf.arg(metavar="N")] = MONOLITHIC_LIMIT,
    device_limit_mb: Annotated[int, tyro.conf.arg(metavar="MB")] = 0,
    seed: int = 0,
) -> int:
    """Measure memory and time as the scene grows and the block does not.

    The scene is a land of equal tiles, one for each block, with cameras over every tile. Each size is made on
    disk and trained for a few visits by ABCD, and for a few steps as one block, each in a process of its own.
    OUT gets scale.json, table.md and a chart. Sizes that OUT already holds are not measured again.

    abcd scale --out scale

    abcd scale --blocks 512 --monolithic-limit 0 --out ten-million

    Args:
        out: folder for the results.
        blocks: sizes of the scene; powers of 2.
        gaussians: in each block.
        visits: of ABCD, for each size.
        ram_budget_mb: RAM for blocks that were read; smaller than the scene, or the chart would show it fill.
        monolithic_limit: scenes with more Gaussians are not tried as one block; 0 for none of them.
        device_limit_mb: GPU memory for each measurement, as if the card had no more; 0 for all of it.
        seed: of the Gaussians and of the order of visits.

    Raises:
        UserError: an option cannot be used, or the disk is too small.
    """
    _check(out, blocks, gaussians, visits, ram_budget_mb)
    limits = {"ram_budget_bytes": ram_budget_mb * MIB, "device_limit_bytes": device_limit_mb * MIB}
    jobs = [ArmJob(k, gaussians, False, visits, **limits, seed=seed) for k in sorted(blocks)]
    few = [k for k in sorted(blocks) if k * gaussians <= monolithic_limit]
    jobs += [ArmJob(k, gaussians, True, 0, **limits, seed=seed) for k in few]
    return carry_out(Plan(out, tuple(jobs)), Console())


def carry_out(plan: Plan, console: Console) -> int:
    """Measure what is missing, and write what came of it; exit code 1 if a measurement failed."""
    plan.out.mkdir(parents=True, exist_ok=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=20),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task("", total=len(plan.jobs))
        for results in measured(plan, console, lambda name: progress.update(task, description=name)):
            write_json(plan.out / RESULTS_FILE, encode(results))  # each time: a long study may be interrupted
            progress.advance(task)
    write_table(results, plan.out / "table.md")
    print_results(results, console)
    for path in (plan.out / RESULTS_FILE, *draw(results, plan.out)):
        console.print(str(path), highlight=False, soft_wrap=True)
    return 1 if results.failures else 0


def measured(
    plan: Plan, console: Console, begin: Callable[[str], None] = lambda _: None
) -> Iterator[ScaleResults]:
    """Measure what is missing, job by job; after each one all that was found so far.

    As soon as a scene is too large for the GPU as one block, larger ones are not tried so.

    Args:
        begin: told the name of each job.
    """
    arms, failed, too_large = [], [], None
    for job in plan.jobs:
        begin(_name(job))
        found = "" if job.monolithic and too_large else measure(job, plan.out / "arms" / _name(job))
        if isinstance(found, Arm):
            arms.append(found)
            console.print(_in_words(found), highlight=False)
        elif job.monolithic and OUT_OF_MEMORY.search(found):
            too_large = job.tiles
            console.print(f"one block, {job.tiles} tiles: out of GPU memory", highlight=False)
        elif found:
            failed.append(f"{_name(job)}: {found}")
            console.print(f"[red]{failed[-1]}[/]", highlight=False)
        yield ScaleResults(
            schema=SCHEMA,
            date=datetime.now(timezone.utc).isoformat(timespec="seconds"),
            command=_command(plan),
            machine=describe_machine(),
            versions=describe_versions(),
            arms=tuple(arms),
            growth=growth(arms),
            failures=tuple(failed),
            one_block_too_large=too_large,
        )


def measure(job: ArmJob, folder: Path) -> Arm | str:
    """The measurement, or why there is none; one that is there already is taken as it is."""
    path, done = folder / JOB_FILE, folder / RESULT_FILE
    if done.exists() and decode(ArmJob, read_json(path), str(path)) == job:
        return decode(Arm, read_json(done), str(done))
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    write_json(path, encode(job))
    with open(folder / LOG_FILE, "wb") as log:
        code = subprocess.run(
            [sys.executable, "-m", "abcd_ns.lab.scale.arm", str(path)],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            env={**os.environ, "PYTHONUNBUFFERED": "1"},
            check=False,
        ).returncode
    for scratch in ("store", "layers"):  # gigabytes; what they took is in the result
        shutil.rmtree(folder / scratch, ignore_errors=True)
    if code == 0:
        return decode(Arm, read_json(done), str(done))
    lines = (folder / LOG_FILE).read_text("utf-8", "replace").strip().splitlines()
    return lines[-1] if lines and code > 0 else f"ended by signal {-code} (out of memory?)"


def _check(out: Path, blocks: tuple[int, ...], gaussians: int, visits: int, ram_budget_mb: int) -> None:
    if out.exists() and not out.is_dir():
        raise UserError(f"--out {out} is a file; name a folder.")
    if out.is_dir() and any(out.iterdir()) and not (out / "arms").is_dir():
        raise UserError(f"--out {out} is not empty and holds no measurements of abcd scale; name another.")
    bad = [k for k in blocks if k < 1 or k & (k - 1)]
    if not blocks or bad or len(set(blocks)) < len(blocks):
        raise UserError(f"--blocks {' '.join(map(str, blocks))}: give different powers of 2, from 1 on.")
    for option, value in (("gaussians", gaussians), ("visits", visits), ("ram-budget-mb", ram_budget_mb)):
        if value < 1:
            raise UserError(f"--{option} is {value}; it must be at least 1.")
    place = next(p for p in (out.resolve(), *out.resolve().parents) if p.exists())
    needed, free = 2 * max(blocks) * gaussians * BYTES_PER_GAUSSIAN, shutil.disk_usage(place).free
    if needed > free:
        raise UserError(
            f"{place} has {free / 2**30:.1f} GiB free, but {max(blocks)} blocks of {gaussians:,} Gaussians "
            f"may take {needed / 2**30:.1f} GiB; give fewer, or --out on another disk."
        )


def _name(job: ArmJob) -> str:
    return f"{'one-block' if job.monolithic else 'abcd'}-{job.tiles}x{job.gaussians_per_tile}"


def _command(plan: Plan) -> str:
    blocks = " ".join(str(job.tiles) for job in plan.jobs if not job.monolithic)
    one = plan.jobs[0]
    words = ["abcd scale --blocks", blocks, "--gaussians", one.gaussians_per_tile, "--visits", one.visits]
    most = max((job.tiles * job.gaussians_per_tile for job in plan.jobs if job.monolithic), default=0)
    words += ["--ram-budget-mb", one.ram_budget_bytes // MIB, "--monolithic-limit", most, "--seed", one.seed]
    words += ["--device-limit-mb", one.device_limit_bytes // MIB] if one.device_limit_bytes else []
    return " ".join(map(str, [*words, "--out OUT"]))


def _in_words(arm: Arm) -> str:
    what = "one block" if arm.monolithic else f"{arm.tiles} blocks"
    device = (
        "" if arm.peak_device_bytes is None else f", {arm.peak_device_bytes / MIB:,.0f} MiB on the device"
    )
    visit = "" if arm.visit_seconds is None else f", {arm.visit_seconds:.1f} s a visit"
    return f"{what}, {arm.gaussians:,} Gaussians: {arm.peak_rss_bytes / MIB:,.0f} MiB of RAM{device}{visit}"
