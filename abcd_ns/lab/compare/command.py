"""`abcd compare`: train ABCD and its peers on one scene and compare."""

import dataclasses
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
import tyro
from rich.console import Console

from abcd_ns.errors import UserError
from abcd_ns.lab.compare.charts import draw_size_accuracy, draw_speed_accuracy
from abcd_ns.lab.compare.pictures import draw_pictures
from abcd_ns.lab.job import METHODS, Job, Method, Plan
from abcd_ns.lab.results.records import decode, read_toml
from abcd_ns.lab.results.results import LeftOut, Results
from abcd_ns.lab.results.run import Failure, Run
from abcd_ns.lab.runs import experiment
from abcd_ns.lab.runs.checks import Flag, make_settings, words

PICTURES = "pictures"


@dataclass(frozen=True, kw_only=True)
class Options:
    """What a user gives, on the command line or in a TOML file; None is what was not given."""

    data: Annotated[str | None, words("PATH")] = None
    """The scene: a folder with a COLMAP model or transforms.json, as for `ns-train abcd --data`."""
    out: Annotated[str | None, words("PATH")] = None
    """Folder for the results; absent, empty, or one of an earlier comparison under the same protocol."""
    methods: Annotated[tuple[Method, ...] | None, words("METHOD ...")] = None
    """Of abcd-monolithic, abcd, abcd-ablated (these are the default), abcd-partition, abcd-exact, abcd-paper
    (needs steps) and splatfacto (needs CUDA)."""
    seconds: Annotated[float | None, words("S")] = None
    """Budget of a run: seconds of training; evaluation, saving and compiling do not count."""
    steps: Annotated[int | None, words("N")] = None
    """Budget of a run: optimisation steps. Give either this or seconds."""
    seeds: Annotated[tuple[int, ...] | None, words("N ...", "--seed")] = None
    """One run of every method for each. Default: 0."""
    downscale: Annotated[int | None, words("N")] = None
    """Divides the photos' width and height. Default: 1."""
    blocks: Annotated[int | None, words("N")] = None
    """Blocks of every method that has any. Default: 8."""
    evals: Annotated[int | None, words("N")] = None
    """Points of the curve of held-out PSNR over time, the last at the end. Default: 8."""
    max_gaussians: Annotated[int | None, words("N")] = None
    """In the whole scene; 0 for no limit. Default: 0."""
    no_densify: Flag = False
    """Train the initial Gaussians only: none are added or pruned."""
    pictures: Annotated[int | None, words("N")] = None
    """Held-out views to show. Default: 3."""

    def over(self, other: "Options") -> "Options":
        """These options, and `other`'s where these were not given."""
        given = {
            name: value for name, value in vars(self).items() if value is not None and value is not False
        }
        if "seconds" in given or "steps" in given:
            # A budget on the command line takes the place of the file's, whatever its unit.
            other = dataclasses.replace(other, seconds=None, steps=None)
        return dataclasses.replace(other, **given)


DEFAULTS = Options(
    methods=METHODS[:3], seeds=(0,), downscale=1, blocks=8, evals=8, max_gaussians=0, pictures=3
)


@tyro.conf.configure(tyro.conf.OmitArgPrefixes)
def compare(
    options: Annotated[Options, tyro.conf.arg(name="")],
    *,
    config: Annotated[Path | None, words("FILE.toml")] = None,
    overwrite: Flag = False,
) -> int:
    """Train several methods on one scene under one protocol, and write what came of it.

    Each run has a process of its own, one after the other. OUT gets results.json, table.md, charts of
    accuracy over training time (speed_accuracy.png and .svg) and over the number of Gaussians
    (size_accuracy), and pictures of held-out views. Called again with the same OUT, it reuses the runs that
    are finished.

    Args:
        options: what is compared, and under which conditions.
        config: TOML file with any of these options by their names; the command line goes before it.
        overwrite: Drop the runs that OUT holds.

    Raises:
        UserError: an option or the scene cannot be used, or OUT holds something else.
    """
    # Here and not above: nerfstudio takes seconds to import, and `--help` has no use for it.
    from abcd_ns.lab.runs.configs import check_scene

    plan = make_plan(options.over(read_options(config)) if config else options)
    check_scene(plan.jobs[0])
    return carry_out(plan, Console(), overwrite)


def read_options(path: Path) -> Options:
    """Options from a TOML file whose keys are the names of the command line's options.

    Raises:
        UserError: the file is absent, is no TOML, or has a key or value that does not fit.
    """
    return decode(Options, read_toml(path, f"--config {path} does not exist."), str(path))


def make_plan(options: Options) -> Plan:
    """Fill in defaults and check everything that can be checked without reading the scene.

    Raises:
        UserError: an option is missing, out of range or contradicts another.
    """
    given = options.over(DEFAULTS)
    for method in given.methods:
        if method not in METHODS:
            raise UserError(f"There is no method {method!r} to compare; there are {', '.join(METHODS)}.")
    if not given.methods or len(set(given.methods)) < len(given.methods):
        raise UserError("Give at least one of --methods, and each once.")
    if "abcd-paper" in given.methods and given.steps is None:
        raise UserError(
            "abcd-paper gives each cell a fixed number of steps: use --steps instead of --seconds."
        )
    shared = {n: v for n, v in vars(given).items() if n not in ("methods", "no_densify")}
    settings = make_settings(**shared, densify=not given.no_densify)
    methods = [method for method in METHODS if method in given.methods]
    jobs = tuple(Job(method, seed, settings) for seed in given.seeds for method in methods)
    out = Path(given.out)
    line = ["abcd", "compare", "--data", settings.scene, "--methods", *methods, "--seeds", *given.seeds]
    line += settings.words()
    line += [] if settings.densify else ["--no-densify"]
    line += ["--pictures", settings.pictures, "--out", out.name]
    return Plan("comparison", settings, out, jobs, shlex.join(map(str, line)))


def carry_out(plan: Plan, console: Console, overwrite: bool = False) -> int:
    """Do all runs of the plan and write what came of them; exit code 1 if a run failed."""

    def draw(results: Results, out: Path) -> list[Path]:
        charts = [*draw_speed_accuracy(results, out), *draw_size_accuracy(results, out)]
        return [*charts, *draw_pictures(first_runs(results, plan), out / PICTURES)]

    return experiment.carry_out(plan, console, draw, overwrite, impossible)


def impossible(job: Job, outcome: Run | Failure | None = None) -> LeftOut | None:  # noqa: ARG001
    """Why the job's method cannot run on this machine or under this protocol, if it cannot."""
    if job.method != "splatfacto":
        return None
    if not torch.cuda.is_available():
        return LeftOut(job.method, "it needs a CUDA device, and there is none here")
    if job.settings.max_gaussians:
        return LeftOut(job.method, "it has no limit on the number of Gaussians, and this protocol sets one")
    return None


def first_runs(results: Results, plan: Plan) -> list[tuple]:
    """A run of each method, of one seed where they share any, with the folder of its pictures."""
    seeds = [{run.seed for run in arm.runs} for arm in results.arms]
    shared = [seed for seed in results.seeds if all(seed in each for each in seeds)]
    first = [next(r for r in arm.runs if not shared or r.seed == shared[0]) for arm in results.arms]
    return [(run, Job(run.method, run.seed, plan.settings).folder(plan.out) / PICTURES) for run in first]
