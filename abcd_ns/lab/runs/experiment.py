"""An experiment: arms x seeds, each run in a process of its own, one file of results, one table, charts."""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from datetime import datetime, timezone
from pathlib import Path

from rich.console import Console

from abcd_ns.lab.job import Job, Plan, Settings
from abcd_ns.lab.results.findings import findings_of
from abcd_ns.lab.results.records import encode, write_json
from abcd_ns.lab.results.results import RESULTS_FILE, SCHEMA, Arm, LeftOut, Results
from abcd_ns.lab.results.run import Failure, Run
from abcd_ns.lab.results.tables import TABLE_FILE, print_table, write_table
from abcd_ns.lab.runs.runner import claim, finish_job
from abcd_ns.machine import Machine, describe_machine, describe_versions

Found = Sequence[tuple[Job, Run | Failure]]
Draw = Callable[[Results, Path], list[Path]]
"""Writes charts of results into a folder and returns their paths."""
LeaveOut = Callable[[Job, Run | Failure | None], LeftOut | None]
"""Why a job's method is left out from now on, if it is; asked before the job, and with what came of it."""


def carry_out(
    plan: Plan, console: Console, draw: Draw, overwrite: bool = False, leave_out: LeaveOut = lambda *_: None
) -> int:
    """Do all jobs of the plan, if `overwrite` after dropping the runs that its folder holds, and write what
    came of them; exit code 1 if a run failed."""
    for results in run_jobs(plan, console, overwrite, leave_out):
        write_json(plan.out / RESULTS_FILE, encode(results))  # each time: a long one may be interrupted
    paths = write_report(results, plan.out, draw)
    if results.arms:
        print_table(results, console)
    print_paths(paths, console)
    return 1 if results.failures else 0


def run_jobs(
    plan: Plan, console: Console, overwrite: bool = False, leave_out: LeaveOut = lambda *_: None
) -> Iterator[Results]:
    """Do the plan's jobs, one by one; after each, all that was found so far."""
    machine, found, left_out = describe_machine(), [], []
    shared = {"settings": dataclasses.asdict(plan.settings), "machine": dataclasses.asdict(machine)}
    claim(plan.out, plan.kind, shared, overwrite)
    for number, job in enumerate(plan.jobs, start=1):
        if job.method in {left.method for left in left_out}:
            continue
        left = leave_out(job, None)
        if left is None:
            outcome = finish_job(job, plan.out, console, f"[{number}/{len(plan.jobs)}] {job.name}")
            left = leave_out(job, outcome)
            found += [(job, outcome)] if left is None else []
        if left is not None:
            left_out.append(left)
            console.print(f"{left.method} is left out: {left.reason}.", highlight=False, soft_wrap=True)
        yield gather(plan, found, machine, left_out)


def gather(plan: Plan, found: Found, machine: Machine, left_out: Sequence[LeftOut] = ()) -> Results:
    """What came of the plan's jobs, with its findings."""
    runs: dict[tuple, list[Run]] = {(job.method, job.variant): [] for job in plan.jobs}
    for job, outcome in found:
        if isinstance(outcome, Run):
            runs[job.method, job.variant].append(outcome)
    settings = plan.settings if isinstance(plan.settings, Settings) else None
    results = new_results(
        plan.kind,
        plan.command,
        machine,
        settings=settings and dataclasses.replace(settings, data=settings.scene),
        seeds=plan.seeds,
        arms=tuple(Arm(m, v.name, v.number, tuple(of)) for (m, v), of in runs.items() if of),
        failures=tuple(outcome for _, outcome in found if isinstance(outcome, Failure)),
        left_out=tuple(left_out),
    )
    return dataclasses.replace(results, findings=findings_of(results))


def new_results(kind: str, command: str, machine: Machine, **fields) -> Results:
    """Results of today, by the packages that are installed; `fields` are more of theirs."""
    date = datetime.now(timezone.utc).isoformat(timespec="seconds")
    return Results(SCHEMA, kind, date, command, machine, describe_versions(), **fields)


def write_report(results: Results, out: Path, draw: Draw) -> list[Path]:
    """Write results.json, table and charts; returns their paths."""
    write_json(out / RESULTS_FILE, encode(results))
    write_table(results, out / TABLE_FILE)
    return [out / RESULTS_FILE, out / TABLE_FILE, *draw(results, out)]


def print_paths(paths: Sequence[Path], console: Console) -> None:
    """What was written."""
    for path in paths:
        console.print(str(path), highlight=False, markup=False, emoji=False, soft_wrap=True)
