"""`abcd study`: vary one thing and see what it does."""

from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from abcd_ns.lab.runs.job import HELD_OUT_EVERY
from abcd_ns.lab.runs.run import Failure, Run
from abcd_ns.lab.runs.runner import claim, run_jobs
from abcd_ns.lab.study.charts import draw_study
from abcd_ns.lab.study.findings import findings_of
from abcd_ns.lab.study.plan import (
    AbcdMethod,
    Conditions,
    StudyPlan,
    plan_blocks,
    plan_gaussians,
    plan_options,
)
from abcd_ns.lab.study.results import SCHEMA, Arm, StudyProtocol, StudyResults, write_study
from abcd_ns.lab.study.tables import print_table, write_table
from abcd_ns.nerfstudio.machine import Machine, describe_machine, describe_versions

RESULTS_FILE, TABLE_FILE = "results.json", "table.md"


def _words(metavar: str, *aliases: str):
    """How --help shows an option without a default of its own."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint="", aliases=aliases or None)


@dataclass(frozen=True, kw_only=True)
class Common:
    """What every study takes."""

    data: Annotated[Path, tyro.conf.arg(metavar="PATH")]
    """The scene: a folder with a COLMAP model or transforms.json, as for `ns-train abcd --data`."""
    out: Annotated[Path, tyro.conf.arg(metavar="PATH")]
    """Folder for the results; absent, empty, or one of an earlier study of the same kind."""
    seconds: Annotated[float | None, _words("S")] = None
    """Budget of a run: seconds of training; evaluation, saving and compiling do not count."""
    steps: Annotated[int | None, _words("N")] = None
    """Budget of a run: optimisation steps. Give either this or --seconds."""
    seeds: Annotated[tuple[int, ...], tyro.conf.arg(metavar="N ...", aliases=("--seed",))] = (0,)
    """Each run once for each. Several tell what is an effect and what is chance."""
    downscale: Annotated[int, tyro.conf.arg(metavar="N")] = 1
    """Divides the photos' width and height."""
    evals: Annotated[int, tyro.conf.arg(metavar="N")] = 4
    """Times that held-out views are scored during a run, the end included."""
    overwrite: Annotated[bool, tyro.conf.FlagCreatePairsOff, tyro.conf.arg(help_behavior_hint="")] = False
    """Drop the runs that OUT holds."""

    def conditions(self, **more: int) -> Conditions:
        """These options, and those that only some studies have."""
        names = ("data", "out", "seconds", "steps", "seeds", "downscale", "evals")
        return Conditions(**{name: getattr(self, name) for name in names}, **more)


@dataclass(frozen=True, kw_only=True)
class BlocksStudy(Common):
    """Held-out quality, time and memory against the number of blocks. The goal: no cliff, the worst number
    within 0.5 dB of the best."""

    blocks: Annotated[tuple[int, ...], tyro.conf.arg(metavar="N ...")] = (1, 2, 4, 8, 16, 27)
    """Numbers of blocks to try."""
    method: AbcdMethod = "abcd"
    """What is trained."""
    max_gaussians: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """In the whole scene, so that no number of blocks wins by having more; 0 for no limit."""

    def plan(self) -> StudyPlan:
        """All runs, checked."""
        return plan_blocks(self.conditions(max_gaussians=self.max_gaussians), self.method, self.blocks)


@dataclass(frozen=True, kw_only=True)
class GaussiansStudy(Common):
    """How few Gaussians a scene needs: held-out quality against the limit on their number, and the knee of
    each curve, the smallest limit within 0.2 dB of the best measured. A limit below the number of initial
    points begins with a random choice of them."""

    max_gaussians: Annotated[tuple[int, ...], tyro.conf.arg(metavar="N ...")] = (
        2000,
        4000,
        8000,
        16000,
        32000,
    )
    """Limits to try, for the whole scene."""
    methods: Annotated[tuple[AbcdMethod, ...], tyro.conf.arg(metavar="METHOD ...")] = (
        "abcd",
        "abcd-monolithic",
    )
    """Of the abcd methods; a curve for each."""
    blocks: Annotated[int, tyro.conf.arg(metavar="N")] = 8
    """Blocks of all but abcd-monolithic."""

    def plan(self) -> StudyPlan:
        """All runs, checked."""
        return plan_gaussians(self.conditions(blocks=self.blocks), self.methods, self.max_gaussians)


@dataclass(frozen=True, kw_only=True)
class OptionsStudy(Common):
    """An ablation: the method as it is, and once more for each change of an option. Names are those of
    `ns-train abcd --help` under --pipeline; several options that change at
    once stand in quotes, as in --vary training.warmup=0 "partition=grid blocks=27"."""

    vary: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE ...")]
    """Changes to try, a row for each; all are checked before the first run."""
    method: AbcdMethod = "abcd"
    """What is changed."""
    blocks: Annotated[int, tyro.conf.arg(metavar="N")] = 8
    """Blocks of all but abcd-monolithic, unless varied."""
    max_gaussians: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """In the whole scene, unless varied; 0 for no limit."""

    def plan(self) -> StudyPlan:
        """All runs, checked."""
        given = self.conditions(blocks=self.blocks, max_gaussians=self.max_gaussians)
        return plan_options(given, self.method, self.vary)


Wanted = (
    Annotated[BlocksStudy, tyro.conf.subcommand("blocks")]
    | Annotated[GaussiansStudy, tyro.conf.subcommand("gaussians")]
    | Annotated[OptionsStudy, tyro.conf.subcommand("options")]
)


@tyro.conf.configure(tyro.conf.OmitSubcommandPrefixes, tyro.conf.OmitArgPrefixes)
def study(wanted: Annotated[Wanted, tyro.conf.arg(name="")]) -> int:
    """Vary one thing and see what it does: the number of blocks, the limit on Gaussians, or any options.

    Each run has a process of its own, one after the other, under the protocol of `abcd compare`. OUT gets
    results.json, table.md and a chart (png and svg). Called again with the same OUT, a study reuses the runs
    that are finished, so that more seeds or more values may be added later.

    abcd study blocks --data scene --seconds 60 --out blocks

    abcd study gaussians --data scene --seconds 60 --out gaussians

    abcd study options --data scene --seconds 60 --vary training.warmup=0 training.batch=1 --out options

    Args:
        wanted: which study.

    Raises:
        UserError: an option cannot be used, or OUT holds something else.
    """
    return carry_out(wanted.plan(), Console(), wanted.overwrite)


def carry_out(plan: StudyPlan, console: Console, overwrite: bool = False) -> int:
    """Do all runs of the plan and write what came of them; exit code 1 if a run failed."""
    machine = describe_machine()
    claim(plan.out, plan, machine, overwrite)
    _announce(plan, console)
    results = gather(plan, run_jobs(plan, console), machine)
    report(results, plan.out, console)
    return 1 if results.failures else 0


def gather(plan: StudyPlan, outcomes: list[Run | Failure], machine: Machine) -> StudyResults:
    """The outcomes, in the order of the plan's jobs, as results with their findings."""
    found = list(zip(plan.jobs, outcomes, strict=True))
    arms = []
    for method in plan.methods:
        for variant in plan.variants:
            runs = tuple(
                outcome
                for job, outcome in found
                if (job.method, job.variant) == (method, variant) and isinstance(outcome, Run)
            )
            value = None if plan.study == "options" else int(variant.changes[0].value)
            arms += [Arm(method, variant.name, value, runs)] if runs else []
    base = {
        "schema": SCHEMA,
        "study": plan.study,
        "protocol": describe_protocol(plan),
        "machine": machine,
        "versions": describe_versions(),
        "arms": tuple(arms),
        "failures": tuple(outcome for outcome in outcomes if isinstance(outcome, Failure)),
        "notes": plan.notes,
    }
    return StudyResults(**base, findings=findings_of(StudyResults(**base)))


def describe_protocol(plan: StudyPlan) -> StudyProtocol:
    """What results.json says of how the study was made."""
    names = ("scene", "downscale", "seconds", "steps", "blocks", "evals", "max_gaussians")
    return StudyProtocol(
        held_out=f"every {HELD_OUT_EVERY}th view of the list sorted by name, from the first on",
        methods=plan.methods,
        varied=tuple(variant.name for variant in plan.variants),
        seeds=plan.seeds,
        date=datetime.now(timezone.utc).isoformat(timespec="seconds"),
        command=plan.command,
        **{name: getattr(plan.settings, name) for name in names},
    )


def report(results: StudyResults, out: Path, console: Console) -> None:
    """Write results.json, table and chart, and print the table."""
    write_study(out / RESULTS_FILE, results)
    write_table(results, out / TABLE_FILE)
    paths = [out / RESULTS_FILE, out / TABLE_FILE, *draw_study(results, out)]
    if results.arms:
        print_table(results, console)
    for path in paths:
        console.print(str(path), highlight=False, markup=False, soft_wrap=True)


def _announce(plan: StudyPlan, console: Console) -> None:
    count, settings = len(plan.jobs), plan.settings
    if settings.seconds is None:
        text = f"{count} runs of {settings.steps:,} steps."
    else:
        minutes = count * settings.seconds / 60
        text = f"{count} runs of {settings.seconds:g} s: {minutes:.0f} min of training and some of start-up."
    console.print(text, highlight=False)
