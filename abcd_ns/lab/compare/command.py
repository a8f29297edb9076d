"""`abcd compare`: train several arms on one scene under one protocol and compare them."""

import dataclasses
import math
import shlex
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console

from abcd_ns.arguments import Flag, check_numbers, check_ranges, words
from abcd_ns.engine.space.partition import MAX_BLOCKS
from abcd_ns.errors import UserError
from abcd_ns.lab.compare.charts import draw_budgets, draw_charts
from abcd_ns.lab.compare.pictures import draw_pictures
from abcd_ns.lab.job import (
    METHODS,
    HoldOut,
    Job,
    Method,
    Plan,
    Settings,
    TerrainJob,
    TerrainSettings,
    scene_name,
)
from abcd_ns.lab.results.records import decode, read_toml
from abcd_ns.lab.results.results import BUDGET, TERRAIN, Results, Run
from abcd_ns.lab.results.tables import notes, print_rows, rows
from abcd_ns.lab.runs.runner import run_jobs, write_report
from abcd_ns.terminal import print_plain
from abcd_ns.units import bytes_in_words

PICTURES = "pictures"
JOINT = "abcd-monolithic"
"""Of what this takes, budgets are shares; within one it has as many Gaussians as fit."""
WITHIN = ("abcd", JOINT, "abcd-ablated", "abcd-partition")  # methods that keep to a budget
ALONE = ("splatfacto", "splatfacto-scaled")  # ceilings, which keep to none


@dataclass(frozen=True, kw_only=True)
class Options:
    """What a user gives, on the command line or in a TOML file; None is what was not given."""

    data: Annotated[str | None, words("PATH")] = None
    """The scene: a folder with a COLMAP model or transforms.json, as for `ns-train abcd --data`."""
    out: Annotated[str | None, words("PATH")] = None
    """Folder for the results; absent, empty, or one of an earlier comparison under the same protocol."""
    methods: Annotated[tuple[Method, ...] | None, words("METHOD ...")] = None
    """Default: abcd-monolithic, abcd, abcd-ablated; abcd alone where an arm is something else than a method.
    Others: abcd-partition, abcd-exact, abcd-paper, splatfacto, splatfacto-scaled.
    Give abcd-paper and splatfacto-scaled --steps. The latter scales schedules made for 30,000 steps."""
    seconds: Annotated[float | None, words("S")] = None
    """Budget of a run: seconds of training; evaluation, saving and compiling do not count."""
    steps: Annotated[int | None, words("N")] = None
    """Budget of a run: optimisation steps. Give either this or seconds."""
    seeds: Annotated[tuple[int, ...] | None, words("N ...", "--seed")] = None
    """One run of every arm for each. Default: 0."""
    downscale: Annotated[int | None, words("N")] = None
    """Divides the photos' width and height. Default: 1."""
    blocks: Annotated[tuple[int, ...] | None, words("N ...")] = None
    """Blocks of every method that has any; an arm for each of several numbers. Default: 8."""
    vary: Annotated[tuple[str, ...] | None, words("NAME=VALUE ...")] = None
    """An arm for each change of an option. Names: docs/reference.md, under --pipeline.
    Several at once stand in quotes, as in --vary training.warmup=0 "partition=grid blocks=27"."""
    tiles: Annotated[tuple[int, ...] | None, words("N ...")] = None
    """An arm for each size of a synthetic terrain, which takes the place of data: a block for each tile."""
    tile_gaussians: Annotated[int | None, words("N")] = None
    """In each tile of the terrain. Default: 20,000."""
    visits: Annotated[int | None, words("N")] = None
    """Budget of a run on the terrain. Default: 3."""
    budgets: Annotated[tuple[str, ...] | None, words("SHARE ...")] = None
    """An arm for each share, such as 1/4, of the memory that abcd-monolithic takes for Gaussians.
    Each method of ABCD's keeps to it. abcd-monolithic and splatfacto also run without a limit."""
    hold_out: HoldOut | None = None
    """Which views are not trained on. Default: auto, those that the data list.
    Without lists every 8th by name, as with interval. With sector an eighth from one place."""
    evals: Annotated[int | None, words("N")] = None
    """Points of the curve of held-out PSNR over time, the last at the end. Default: 8."""
    pictures: Annotated[int | None, words("N")] = None
    """Held-out views to show. Default: 3."""

    @property
    def given(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if value is not None}

    def over(self, other: "Options") -> "Options":
        """These options, and `other`'s where these were not given."""
        if "seconds" in self.given or "steps" in self.given:
            # A budget on the command line takes the place of the file's, whatever its unit.
            other = dataclasses.replace(other, seconds=None, steps=None)
        return dataclasses.replace(other, **self.given)


DEFAULTS = Options(
    methods=METHODS[:3], seeds=(0,), downscale=1, blocks=(8,), vary=(), hold_out="auto", evals=8, pictures=3
)
TERRAIN_DEFAULTS = Options(methods=("abcd",), seeds=(0,), tile_gaussians=20_000, visits=3)
TERRAIN_OPTIONS = {*TERRAIN_DEFAULTS.given, "tiles", "out"}
BYTES_PER_GAUSSIAN = 3 * 59 * 4  # on disk: parameters and two moments in float32


@tyro.conf.configure(tyro.conf.OmitArgPrefixes)
def compare(
    options: Annotated[Options, tyro.conf.arg(name="")],
    *,
    config: Annotated[Path | None, words("FILE.toml")] = None,
    overwrite: Flag = False,
) -> int:
    """Train several arms on one scene under one protocol, and write what came of it.

    Arms are methods, each with every number of blocks, and each as it is and with every change. Each run has
    a process of its own, one after the other. OUT gets results.json, table.md, charts of PSNR over training
    time (speed_accuracy.png), PSNR over Gaussians (size_accuracy.png) and memory over Gaussians (memory.png),
    and pictures of held-out views. Called again with the same OUT, it reuses the runs that are finished, so
    that more seeds and arms may be added later.

    abcd compare --data scene --seconds 60 --seeds 0 1 --out methods

    abcd compare --data scene --seconds 60 --methods abcd --blocks 1 2 4 8 16 27 --out blocks

    abcd compare --data scene --seconds 60 --vary training.warmup=0 training.batch=1 --out options

    abcd compare --data scene --steps 4000 --budgets 1/2 1/4 1/8 --methods abcd splatfacto --out budgets

    abcd compare --tiles 2 4 8 16 32 64 --methods abcd abcd-monolithic --out sizes

    Args:
        options: what is compared, and under which conditions.
        config: TOML file with any of these options by their names; the command line goes before it.
        overwrite: Drop the runs that OUT holds.

    Raises:
        UserError: an option or the scene cannot be used, or OUT holds something else.
    """
    options = options.over(read_options(config)) if config else options
    plan = make_plan(options)
    if plan.kind != TERRAIN:
        from abcd_ns.lab.runs.configs import check_options, check_scene  # loads nerfstudio, in seconds

        for job in plan.jobs:
            check_options(job)
        plan = dataclasses.replace(plan, scene=check_scene(plan.jobs[0]))
    console = Console()
    if options.budgets:
        *_, ceilings = run_jobs(plan, console, overwrite)
        methods = options.over(DEFAULTS).methods
        plan, overwrite = within_budgets(plan, ceilings, methods, shares_of(options.budgets)), False
    return carry_out(plan, console, overwrite)


def read_options(path: Path) -> Options:
    """Options from a TOML file whose keys are the command line's names; a UserError where that is not so."""
    values = read_toml(path, f"--config {path} does not exist.")
    if isinstance(values.get("blocks"), int):
        values["blocks"] = [values["blocks"]]
    return decode(Options, values, str(path))


def make_plan(options: Options) -> Plan:
    """Fill in defaults and check all that can be checked without reading the scene; a UserError if an option
    is missing, out of range or contradicts another."""
    if len(options.blocks or ()) > 1 or options.vary:
        options = options.over(Options(methods=("abcd",)))
    given = options.over(DEFAULTS if options.tiles is None else TERRAIN_DEFAULTS)
    if not given.methods or len(set(given.methods)) < len(given.methods):
        raise UserError("Give at least one of --methods, and each once.")
    if given.steps is None and (counted := {"abcd-paper", "splatfacto-scaled"} & set(given.methods)):
        raise UserError(f"The schedule of {min(counted)} is in steps: use --steps instead of --seconds.")
    check_numbers("--seeds", given.seeds, 0)
    if given.out is None:
        raise UserError("Give the folder for the results with --out FOLDER.")
    given = dataclasses.replace(given, methods=tuple(m for m in METHODS if m in given.methods))
    if given.tiles is not None:
        return _terrain_plan(given)
    if others := {"tile_gaussians", "visits"} & given.given.keys():
        raise UserError(f"--{min(others).replace('_', '-')} goes with --tiles only.")
    if given.budgets is not None:
        return _budgets_plan(given, options)
    settings, arms = _settings(given), arms_of(given)
    jobs = tuple(
        Job(method, seed, settings, changes)
        for seed in given.seeds
        for method in given.methods
        for changes in dict.fromkeys(_for_method(changes, method) for changes in arms)
    )
    return Plan("comparison", settings, Path(given.out), jobs, _command(given))


def _budgets_plan(given: Options, asked: Options) -> Plan:
    """The runs without a limit: what budgets are shares of, and ceilings."""
    shares_of(given.budgets)
    if others := {"blocks", "vary"} & asked.given.keys():
        raise UserError(f"--{min(others)} does not go with --budgets.")
    if others := set(given.methods) - {*WITHIN, *ALONE}:
        raise UserError(f"{min(others)} keeps to no budget: leave it out.")
    settings = dataclasses.replace(_settings(given), blocks=0)
    command = _command(dataclasses.replace(given, blocks=None, vary=None))
    methods = [m for m in METHODS if m == JOINT or (m in ALONE and m in given.methods)]
    jobs = tuple(Job(method, seed, settings) for seed in given.seeds for method in methods)
    return Plan("comparison", settings, Path(given.out), jobs, command)


def shares_of(texts: Sequence[str]) -> list[Fraction]:
    """The budgets, the largest first; a UserError where one is no share."""
    try:
        found = {Fraction(text) for text in texts}
    except (ValueError, ZeroDivisionError):
        found = set()
    if not found or min(found) <= 0 or max(found) > 1:
        raise UserError(f"--budgets {' '.join(texts)}: give shares above 0 and up to 1, such as 1/4.")
    return sorted(found, reverse=True)


def within_budgets(plan: Plan, ceilings: Results, methods: Sequence[str], shares: Sequence[Fraction]) -> Plan:
    """The plan, and methods within shares of the memory of joint training; a UserError where that failed."""
    took = [run.gaussian_bytes for run in ceilings.runs if run.method == JOINT]
    if not took:
        raise UserError(f"{JOINT} failed, of whose memory the budgets are shares; see its log.")
    jobs = tuple(
        Job(method, seed, plan.settings, (f"{BUDGET}={int(share * max(took))}",))
        for seed in ceilings.seeds
        for share in shares
        for method in METHODS
        if method in WITHIN and method in (*methods, JOINT)
    )
    return dataclasses.replace(plan, jobs=(*plan.jobs, *jobs))


def _terrain_plan(given: Options) -> Plan:
    """Runs on terrains of so many tiles."""
    if others := given.given.keys() - TERRAIN_OPTIONS:
        raise UserError(f"--{min(others).replace('_', '-')} does not go with --tiles.")
    if others := set(given.methods) - {"abcd", "abcd-monolithic"}:
        raise UserError(f"--tiles is for abcd and abcd-monolithic, not {min(others)}.")
    tiles = sorted(given.tiles)
    if not tiles or tiles != sorted(set(tiles)) or any(n < 1 or n & (n - 1) for n in tiles):
        raise UserError(f"--tiles {' '.join(map(str, tiles))}: give different powers of 2, from 1 on.")
    check_ranges({"tile_gaussians": given.tile_gaussians, "visits": given.visits})
    out, gaussians = Path(given.out), tiles[-1] * given.tile_gaussians
    place = next(p for p in (out.resolve(), *out.resolve().parents) if p.exists())
    needed, free = 2 * gaussians * BYTES_PER_GAUSSIAN, shutil.disk_usage(place).free
    if needed > free:
        raise UserError(
            f"{place} has {bytes_in_words(free)} free, but {gaussians:,} Gaussians may take "
            f"{bytes_in_words(needed)}; give fewer, or --out on another disk."
        )
    settings = TerrainSettings(given.tile_gaussians, given.visits)
    jobs = terrain_jobs(settings, tiles, given.methods, given.seeds)
    return Plan(TERRAIN, settings, out, jobs, _command(given))


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


def arms_of(given: Options) -> list[tuple[str, ...]]:
    """What each arm changes: every number of blocks, if there are several, with nothing and with each of
    --vary. A UserError where an option does not exist, or a value does not fit."""
    check_numbers("--blocks", given.blocks, 1)
    if given.vary:
        from abcd_ns.lab.runs.configs import REGISTERED  # these load nerfstudio, in seconds
        from abcd_ns.lab.runs.options import parse_changes
    changes = [parse_changes(text, REGISTERED["abcd"].pipeline) for text in given.vary]
    sizes = [(f"blocks={n}",) for n in sorted(given.blocks)] if len(given.blocks) > 1 else [()]
    of_blocks = [one for one in changes if len(sizes) > 1 and any(c.startswith("blocks=") for c in one)]
    sets = list(map(set, changes))
    if twice := [one for one in changes if sets.count(set(one)) > 1] + of_blocks:
        raise UserError(f"{' '.join(twice[0])!r} is given twice.")
    return [(*size, *change) for size in sizes for change in [(), *changes]]


def carry_out(plan: Plan, console: Console, overwrite: bool = False) -> int:
    """Do all runs of the plan and write what came of them; exit code 1 if a run failed."""
    for results in run_jobs(plan, console, overwrite):
        paths = write_report(results, plan.out)  # each time: a long one may be interrupted
    paths += [*draw_charts(results, plan.out), *draw_budgets(results, plan.out)]
    if plan.kind != TERRAIN:
        paths += draw_pictures(shown(results, plan), plan.out / PICTURES)
    if results.arms:
        print_rows(rows(results), [*results.findings, *notes(results)], console)
    for path in paths:
        print_plain(str(path), console)
    return 1 if results.failures else 0


def shown(results: Results, plan: Plan) -> list[tuple[str, Run, Path]]:
    """Of each method the first arm without a budget and the one within the smallest: its label, a run, of one
    seed where they share any, and the folder of its pictures."""
    arms = []
    for method in results.methods:
        own = results.of(method)
        budgeted = [arm for arm in own if arm.is_budgeted]
        arms += [arm for arm in own if not arm.is_budgeted][:1] + budgeted[-1:]
    seeds = [{run.seed for run in arm.runs} for arm in arms]
    shared = [seed for seed in results.seeds if all(seed in each for each in seeds)]
    folders = {(job.method, job.variant, job.seed): job.folder(plan.out) for job in plan.jobs}
    runs = [(arm, next(run for run in arm.runs if not shared or run.seed == shared[0])) for arm in arms]
    return [
        (results.labels[arm.name], run, folders[arm.method, arm.variant, run.seed] / PICTURES)
        for arm, run in runs
    ]


def _settings(given: Options) -> Settings:
    if given.data is None:
        raise UserError("Give the scene with --data FOLDER.")
    if not Path(given.data).exists():
        raise UserError(f"--data {given.data} does not exist.")
    if (given.seconds is None) == (given.steps is None):
        raise UserError("Give each run's budget: either --seconds or --steps.")
    if given.seconds is not None and not 0 < given.seconds < math.inf:
        raise UserError(f"--seconds is {given.seconds}; it must be above 0 and finite.")
    check_ranges({name: getattr(given, name) for name in ("downscale", "steps", "evals", "pictures")})
    if max(given.blocks, default=1) > MAX_BLOCKS:
        raise UserError(f"--blocks is {max(given.blocks)}; it must be at most {MAX_BLOCKS}.")
    return Settings(
        data=str(Path(given.data).resolve()),
        downscale=given.downscale,
        blocks=given.blocks[0] if len(given.blocks) == 1 else 0,
        seconds=given.seconds,
        steps=given.steps,
        evals=given.evals,
        pictures=given.pictures,
        hold_out=given.hold_out,
    )


def _for_method(changes: tuple[str, ...], method: str) -> tuple[str, ...]:
    """What of an arm applies to a method: one block is one block, and splatfacto has its own options."""
    if method in ALONE:
        return ()
    if method == "abcd-monolithic":
        return tuple(change for change in changes if not change.startswith("blocks="))
    return changes


def _command(given: Options) -> str:
    """The command line that makes the same, with the names of folders instead of where they are."""
    line = ["abcd", "compare"]
    for name, value in given.given.items():
        if name in ("data", "out"):
            value = scene_name(value)
        values = value if isinstance(value, tuple) else [value]
        texts = [f"{one:g}" if isinstance(one, float) else str(one) for one in values]
        line += [f"--{name.replace('_', '-')}", *texts] if value != () else []
    return shlex.join(line)
