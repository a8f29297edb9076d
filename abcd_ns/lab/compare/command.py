"""`abcd compare`: train ABCD and its peers on one scene and compare."""

from datetime import datetime, timezone
from pathlib import Path
from typing import Annotated

import torch
import tyro
from rich.console import Console

from abcd_ns.lab.compare.charts import draw_size_accuracy, draw_speed_accuracy
from abcd_ns.lab.compare.pictures import draw_pictures
from abcd_ns.lab.compare.protocol import Options, Plan, make_plan, read_options
from abcd_ns.lab.compare.results import SCHEMA, LeftOut, Protocol, Results, write_results
from abcd_ns.lab.compare.tables import print_table, write_table
from abcd_ns.lab.runs.job import HELD_OUT_EVERY, Job, Method
from abcd_ns.lab.runs.run import Failure, Run
from abcd_ns.lab.runs.runner import claim, run_jobs
from abcd_ns.nerfstudio.machine import describe_machine, describe_versions

RESULTS_FILE, TABLE_FILE, PICTURES = "results.json", "table.md", "pictures"


def _words(metavar: str, *aliases: str):
    """How --help shows an option that is None unless it is given."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint="", aliases=aliases or None)


Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff, tyro.conf.arg(help_behavior_hint="")]


def compare(
    *,
    data: Annotated[Path | None, _words("PATH")] = None,
    out: Annotated[Path | None, _words("PATH")] = None,
    methods: Annotated[tuple[Method, ...] | None, _words("METHOD ...")] = None,
    seconds: Annotated[float | None, _words("S")] = None,
    steps: Annotated[int | None, _words("N")] = None,
    seeds: Annotated[tuple[int, ...] | None, _words("N ...", "--seed")] = None,
    downscale: Annotated[int | None, _words("N")] = None,
    blocks: Annotated[int | None, _words("N")] = None,
    evals: Annotated[int | None, _words("N")] = None,
    max_gaussians: Annotated[int | None, _words("N")] = None,
    no_densify: Flag = False,
    pictures: Annotated[int | None, _words("N")] = None,
    config: Annotated[Path | None, _words("FILE.toml")] = None,
    overwrite: Flag = False,
) -> int:
    """Train several methods on one scene under one protocol, and write what came of it.

    Each run has a process of its own, one after the other. OUT gets results.json, table.md, charts of
    accuracy over training time (speed_accuracy.png and .svg) and over the number of Gaussians
    (size_accuracy), and pictures of held-out views. Called again with the same OUT, it reuses the runs that
    are finished.

    Args:
        data: The scene: a folder with a COLMAP model or transforms.json, as for `ns-train abcd --data`.
        out: Folder for the results; absent, empty, or one of an earlier comparison under the same protocol.
        methods: Of abcd-monolithic, abcd, abcd-ablated (these are the default), abcd-partition, abcd-exact,
            abcd-paper (needs steps) and splatfacto (needs CUDA).
        seconds: Budget of a run: seconds of training; evaluation, saving and compiling do not count.
        steps: Budget of a run: optimisation steps. Give either this or seconds.
        seeds: One run of every method for each. Default: 0.
        downscale: Divides the photos' width and height. Default: 1.
        blocks: Blocks of every method that has any. Default: 8.
        evals: Points of the curve of held-out PSNR over time, the last at the end. Default: 8.
        max_gaussians: In the whole scene; 0 for no limit. Default: 0.
        no_densify: Train the initial Gaussians only: none are added or pruned.
        pictures: Held-out views to show. Default: 3.
        config: TOML file with any of these options by their names; the command line goes before it.
        overwrite: Drop the runs that OUT holds.

    Raises:
        UserError: an option cannot be used, or OUT holds something else.
    """
    given = Options(
        data=data and str(data),
        out=out and str(out),
        methods=methods,
        seconds=seconds,
        steps=steps,
        seeds=seeds,
        downscale=downscale,
        blocks=blocks,
        evals=evals,
        max_gaussians=max_gaussians,
        no_densify=no_densify or None,
        pictures=pictures,
    )
    plan = make_plan(given.over(read_options(config)) if config else given)
    return carry_out(plan, Console(), overwrite)


def carry_out(plan: Plan, console: Console, overwrite: bool = False) -> int:
    """Do all runs of the plan and write what came of them; exit code 1 if a run failed."""
    plan, left_out = without_impossible(plan)
    for left in left_out:
        console.print(f"{left.method} is left out: {left.reason}.", highlight=False, soft_wrap=True)
    machine = describe_machine()
    claim(plan.out, plan, machine, overwrite)
    outcomes = run_jobs(plan, console)
    results = Results(
        schema=SCHEMA,
        protocol=describe_protocol(plan),
        machine=machine,
        versions=describe_versions(),
        runs=tuple(outcome for outcome in outcomes if isinstance(outcome, Run)),
        failures=tuple(outcome for outcome in outcomes if isinstance(outcome, Failure)),
        left_out=left_out,
    )
    report(results, plan, console)
    return 1 if results.failures else 0


def without_impossible(plan: Plan) -> tuple[Plan, tuple[LeftOut, ...]]:
    """The plan without the methods that cannot run on this machine or under this protocol, and why."""
    reason = None
    if not torch.cuda.is_available():
        reason = "it needs a CUDA device, and there is none here"
    elif plan.settings.max_gaussians:
        reason = "it has no limit on the number of Gaussians, and this protocol sets one"
    if reason is None or "splatfacto" not in plan.methods:
        return plan, ()
    methods = tuple(method for method in plan.methods if method != "splatfacto")
    return Plan(plan.settings, methods, plan.seeds, plan.out), (LeftOut("splatfacto", reason),)


def describe_protocol(plan: Plan) -> Protocol:
    """What results.json says of how the comparison was made."""
    settings = plan.settings
    return Protocol(
        scene=settings.scene,
        held_out=f"every {HELD_OUT_EVERY}th view of the list sorted by name, from the first on",
        methods=plan.methods,
        seeds=plan.seeds,
        date=datetime.now(timezone.utc).isoformat(timespec="seconds"),
        command=plan.command,
        **{
            name: getattr(settings, name)
            for name in (
                "downscale",
                "seconds",
                "steps",
                "blocks",
                "evals",
                "max_gaussians",
                "densify",
                "pictures",
            )
        },
    )


def report(results: Results, plan: Plan, console: Console) -> None:
    """Write results.json, table, chart and pictures, and print the table."""
    out = plan.out
    write_results(out / RESULTS_FILE, results)
    write_table(results, out / TABLE_FILE)
    paths = [
        out / RESULTS_FILE,
        out / TABLE_FILE,
        *draw_speed_accuracy(results, out),
        *draw_size_accuracy(results, out),
        *draw_pictures(_first_runs(results, plan), out / PICTURES),
    ]
    if results.runs:
        print_table(results, console)
    for path in paths:
        console.print(str(path), highlight=False, markup=False, soft_wrap=True)


def _first_runs(results: Results, plan: Plan) -> list[tuple[Run, Path]]:
    """Each method's first run, with the folder of its pictures."""
    first = [results.of(method)[0] for method in results.methods]
    return [(run, Job(run.method, run.seed, plan.settings).folder(plan.out) / PICTURES) for run in first]
