"""`abcd compare --tiles`: memory and time as a synthetic terrain grows and its blocks do not."""

import shlex
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from abcd_ns.errors import UserError
from abcd_ns.lab.job import Plan, TerrainJob, TerrainSettings
from abcd_ns.lab.results.results import TERRAIN
from abcd_ns.lab.runs.options import check_ranges
from abcd_ns.units import bytes_in_words

METHODS = {"abcd", "abcd-monolithic"}
OPTIONS = {"tiles", "tile_gaussians", "visits", "methods", "seeds", "out"}
"""Those that a comparison on a terrain has."""
BYTES_PER_GAUSSIAN = 3 * 59 * 4
"""On disk: parameters and two moments in float32."""


def terrain_plan(given: Mapping[str, Any], methods: Sequence[str], seeds: Sequence[int]) -> Plan:
    """Runs on terrains of so many tiles, checked.

    Args:
        given: options that were given, by name.

    Raises:
        UserError: an option cannot be used, or the disk is too small.
    """
    if others := given.keys() - OPTIONS:
        raise UserError(f"--{min(others).replace('_', '-')} does not go with --tiles.")
    if others := set(methods) - METHODS:
        raise UserError(f"--tiles is for {' and '.join(sorted(METHODS))}, not {min(others)}.")
    tiles, out = sorted(given["tiles"]), Path(given["out"])
    if not tiles or len(set(tiles)) < len(tiles) or any(n < 1 or n & (n - 1) for n in tiles):
        raise UserError(f"--tiles {' '.join(map(str, tiles))}: give different powers of 2, from 1 on.")
    settings = TerrainSettings(given.get("tile_gaussians", 20_000), given.get("visits", 3))
    check_ranges({"tile_gaussians": settings.gaussians, "visits": settings.visits})
    _check_disk(out, max(tiles) * settings.gaussians)
    line = ["abcd", "compare", "--tiles", *tiles, "--methods", *methods, "--seeds", *seeds]
    line += ["--tile-gaussians", settings.gaussians, "--visits", settings.visits, "--out", out.name]
    jobs = terrain_jobs(settings, tiles, methods, seeds)
    return Plan(TERRAIN, settings, out, jobs, shlex.join(map(str, line)))


def terrain_jobs(
    settings: TerrainSettings, tiles: Sequence[int], methods: Sequence[str], seeds: Sequence[int]
) -> tuple[TerrainJob, ...]:
    """The smallest first, by blocks before as one block, which may need more memory than there is."""
    return tuple(
        TerrainJob(method, seed, settings, (f"tiles={count}",))
        for count in tiles
        for method in sorted(methods)
        for seed in seeds
    )


def _check_disk(out: Path, gaussians: int) -> None:
    place = next(p for p in (out.resolve(), *out.resolve().parents) if p.exists())
    needed, free = 2 * gaussians * BYTES_PER_GAUSSIAN, shutil.disk_usage(place).free
    if needed > free:
        raise UserError(
            f"{place} has {bytes_in_words(free)} free, but {gaussians:,} Gaussians may take "
            f"{bytes_in_words(needed)}; give fewer, or --out on another disk."
        )
