"""`abcd scale`: does memory follow the block and not the scene?"""

import re
import shlex
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from abcd_ns.errors import UserError
from abcd_ns.lab.job import Change, Plan, Variant
from abcd_ns.lab.results.results import LeftOut
from abcd_ns.lab.results.run import Failure, Run
from abcd_ns.lab.runs import experiment
from abcd_ns.lab.runs.checks import Flag, Number, Numbers, check_ranges
from abcd_ns.lab.scale.charts import draw_scale
from abcd_ns.lab.scale.worker import AS_ONE, LandJob, LandSettings
from abcd_ns.units import MIB, bytes_in_words

BYTES_PER_GAUSSIAN = 3 * 59 * 4
"""On disk: parameters and two moments in float32."""
OUT_OF_MEMORY = re.compile(r"CUDA (error: )?out of memory")
"""How torch and CUDA say it, in the last line of a log."""
MONOLITHIC_LIMIT = 4_000_000
"""Gaussians; larger scenes are not tried as one block unless asked for."""
Mebibytes = Annotated[int, tyro.conf.arg(metavar="MiB")]


def scale(
    out: Annotated[Path, tyro.conf.arg(metavar="PATH")],
    blocks: Numbers = (2, 4, 8, 16, 32, 64),
    gaussians: Number = 20_000,
    visits: Number = 3,
    ram_budget_mb: Mebibytes = 16,
    monolithic_limit: Number = MONOLITHIC_LIMIT,
    device_limit_mb: Mebibytes = 0,
    seed: int = 0,
    overwrite: Flag = False,
) -> int:
    """Measure memory and time as the scene grows and the block does not.

    The scene is a land of equal tiles, one for each block, with cameras over every tile. Each size is made on
    disk and trained for a few visits by ABCD, and for a few steps as one block, each in a process of its own.
    OUT gets results.json, table.md and a chart. Sizes that OUT already holds are not measured again.

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
        overwrite: Drop the measurements that OUT holds.

    Raises:
        UserError: an option cannot be used, or the disk is too small.
    """
    bad = [k for k in blocks if k < 1 or k & (k - 1)]
    if not blocks or bad or len(set(blocks)) < len(blocks):
        raise UserError(f"--blocks {' '.join(map(str, blocks))}: give different powers of 2, from 1 on.")
    check_ranges({"gaussians": gaussians, "visits": visits, "ram_budget_mb": ram_budget_mb})
    check_ranges({"monolithic_limit": monolithic_limit, "device_limit_mb": device_limit_mb}, low=0)
    _check_disk(out, max(blocks) * gaussians)
    settings = LandSettings(gaussians, visits, ram_budget_mb * MIB, device_limit_mb * MIB)
    few = [k for k in sorted(blocks) if k * gaussians <= monolithic_limit]
    plan = make_plan(out, settings, sorted(blocks), few, seed)
    return experiment.carry_out(plan, Console(), draw_scale, overwrite, too_large)


def make_plan(
    out: Path, settings: LandSettings, by_blocks: Sequence[int], whole: Sequence[int], seed: int
) -> Plan:
    """Measurements of lands of so many tiles, by blocks, and then as one block."""
    sizes = [("abcd", by_blocks), (AS_ONE, whole)]
    jobs = tuple(
        LandJob(method, seed, settings, Variant((Change("tiles", str(count)),)))
        for method, counts in sizes
        for count in counts
    )
    words = ["abcd", "scale", "--blocks", *by_blocks, "--gaussians", settings.gaussians]
    words += ["--visits", settings.visits, "--ram-budget-mb", settings.ram_budget_bytes // MIB]
    words += ["--monolithic-limit", max(whole, default=0) * settings.gaussians, "--seed", seed]
    limit = settings.device_limit_bytes // MIB
    words += ["--device-limit-mb", limit] if limit else []
    return Plan("study of scale", settings, out, jobs, shlex.join(map(str, [*words, "--out", out.name])))


def too_large(job: LandJob, outcome: Run | Failure | None) -> LeftOut | None:
    """Larger scenes are not tried as one block where a smaller one was too large for the GPU."""
    if job.method == AS_ONE and isinstance(outcome, Failure) and OUT_OF_MEMORY.search(outcome.reason):
        return LeftOut(AS_ONE, f"as one block, {job.tiles} tiles ran out of GPU memory")
    return None


def _check_disk(out: Path, gaussians: int) -> None:
    place = next(p for p in (out.resolve(), *out.resolve().parents) if p.exists())
    needed, free = 2 * gaussians * BYTES_PER_GAUSSIAN, shutil.disk_usage(place).free
    if needed > free:
        raise UserError(
            f"{place} has {bytes_in_words(free)} free, but {gaussians:,} Gaussians may take "
            f"{bytes_in_words(needed)}; give fewer, or --out on another disk."
        )
