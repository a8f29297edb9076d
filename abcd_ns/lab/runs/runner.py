"""Does a plan: each job in a process of its own, what earlier calls finished reused, results after each.

At the end is what such a process does: read its job, do it, write its run beside it.
"""

import dataclasses
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from abcd_ns.errors import UserError
from abcd_ns.lab.job import Job, Plan, Settings, TerrainJob
from abcd_ns.lab.results.records import RecordError, decode, read_json, write_json
from abcd_ns.lab.results.results import RESULTS_FILE, SCHEMA, Arm, Failure, LeftOut, Results, Run
from abcd_ns.lab.results.tables import TABLE_FILE, findings_of, write_table
from abcd_ns.machine import (
    Machine,
    describe_machine,
    describe_versions,
    end_with_parent,
    peak_device_bytes,
    peak_rss_bytes,
)
from abcd_ns.terminal import print_plain

JOB_FILE, LOG_FILE, RUN_FILE = "job.json", "log.txt", "run.json"
SCENE = "photos and points"  # of the scene, in the file by which a folder is known
OUT_OF_MEMORY = re.compile(r"CUDA (error: )?out of memory")
"""How torch and CUDA say it, in the last line of a log."""
MOST_IN_ONE_BLOCK = 4_000_000  # Gaussians; larger terrains are not tried as one block


def run_jobs(plan: Plan, console: Console, overwrite: bool = False) -> Iterator[Results]:
    """Do the plan's jobs, one by one; after each, all that was found so far. `overwrite` drops the runs that
    its folder holds. A UserError if that holds something else, or runs that cannot be compared with these."""
    machine, found, left_out = describe_machine(), [], {}
    shared = {**dataclasses.asdict(plan.settings), SCENE: plan.scene, **dataclasses.asdict(machine)}
    claim(plan.out, plan.kind, shared, overwrite)
    for number, job in enumerate(plan.jobs, start=1):
        if job.method in left_out:
            continue
        outcome, reason = None, why_left_out(job)
        if reason is None:
            outcome = finish_job(job, plan.out, console, f"[{number}/{len(plan.jobs)}] {job.name}")
            reason = why_left_out(job, outcome)
        if reason is None:
            found.append((job, outcome))
        else:
            left_out[job.method] = reason
            print_plain(f"{job.method} is left out: {reason}.", console)
        yield gather(plan, found, machine, left_out)


def why_left_out(job: Job, outcome: Run | Failure | None = None) -> str | None:
    """Why the job's method cannot run on this machine or under this protocol, if it cannot; by `outcome`, if
    it was tried."""
    if isinstance(job, TerrainJob) and job.method == "abcd-monolithic":
        if job.value * job.settings.gaussians > MOST_IN_ONE_BLOCK:
            return f"{job.value} tiles have more than {MOST_IN_ONE_BLOCK:,} Gaussians"
        if isinstance(outcome, Failure) and OUT_OF_MEMORY.search(outcome.reason):
            return f"as one block, {job.value} tiles ran out of GPU memory"
    return None


def gather(
    plan: Plan, found: Sequence[tuple[Job, Run | Failure]], machine: Machine, left_out: Mapping[str, str]
) -> Results:
    """What came of the plan's jobs, with its findings; `left_out` has reasons by method."""
    runs: dict[tuple, list[Run]] = {(job.method, job.variant, job.value): [] for job in plan.jobs}
    for job, outcome in found:
        if isinstance(outcome, Run):
            runs[job.method, job.variant, job.value].append(outcome)
    scene = plan.settings if isinstance(plan.settings, Settings) else None
    results = new_results(
        plan.kind,
        plan.command,
        machine,
        settings=scene and dataclasses.replace(scene, data=scene.scene),
        seeds=tuple(dict.fromkeys(job.seed for job in plan.jobs)),
        arms=tuple(Arm(*key, tuple(of)) for key, of in runs.items() if of),
        failures=tuple(outcome for _, outcome in found if isinstance(outcome, Failure)),
        left_out=tuple(LeftOut(*pair) for pair in left_out.items()),
    )
    return dataclasses.replace(results, findings=findings_of(results))


def new_results(kind: str, command: str, machine: Machine, **fields: Any) -> Results:
    """Results of today, by the packages that are installed; `fields` are more of theirs."""
    date = datetime.now(timezone.utc).isoformat(timespec="seconds")
    return Results(SCHEMA, kind, date, command, machine, describe_versions(), **fields)


def write_report(results: Results, out: Path) -> list[Path]:
    """Write results.json and the table; returns their paths."""
    write_json(out / RESULTS_FILE, dataclasses.asdict(results))
    write_table(results, out / TABLE_FILE)
    return [out / RESULTS_FILE, out / TABLE_FILE]


def claim(out: Path, kind: str, shared: Mapping[str, Any], overwrite: bool = False) -> None:
    """Make `out` the folder of an experiment's results, whose runs have `shared` in common, by name: values
    of JSON's. `overwrite` drops the runs that are there. A UserError if `out` holds something else, or runs
    that do not share that, or cannot be written."""
    marker = out / f"{kind.replace(' ', '-')}.json"
    with taking(out):
        if take_folder(out, marker, kind) and overwrite:
            shutil.rmtree(out / "runs", ignore_errors=True)
        elif marker.exists():
            theirs = read_json(marker)
            for name, new in shared.items():
                old = theirs.get(name) if isinstance(theirs, dict) else None
                if name == SCENE and None in (old, new):
                    continue  # older folders do not say
                if old != new:
                    raise UserError(
                        f"--out {out} holds runs with {name} {old}, not {new}, which cannot be "
                        "compared; name another folder, or drop them with --overwrite."
                    )
        write_json(marker, dict(shared))


@contextmanager
def taking(out: Path) -> Iterator[None]:
    """Make a UserError of what the operating system says about writing to a user's folder."""
    try:
        yield
    except OSError as error:
        raise UserError(f"{out} cannot be written: {error.strerror}; name another folder.") from None


def take_folder(out: Path, marker: Path, kind: str) -> bool:
    """Whether `out` is there already, with its marker; it is made where it is absent. A UserError where it is
    a file, or a folder of something else."""
    if out.exists() and not out.is_dir():
        raise UserError(f"{out} is a file; name a folder.")
    if not marker.exists() and out.is_dir() and any(out.iterdir()):
        raise UserError(f"{out} is not empty and holds no {kind}; name another folder.")
    out.mkdir(parents=True, exist_ok=True)
    return marker.exists()


def finished_run(job: Job, out: Path) -> Run | None:
    """The run of the very same job that an earlier call finished, if any."""
    folder = job.folder(out)
    try:
        if decode(type(job), read_json(folder / JOB_FILE), str(folder)) != job:
            return None
        return decode(Run, read_json(folder / RUN_FILE), str(folder / RUN_FILE))
    except RecordError:
        return None  # unfinished, or of another version of this program: to be run again


def finish_job(job: Job, out: Path, console: Console, head: str) -> Run | Failure:
    """The job's run, made now if no earlier call did; `head` begins every line about it."""
    outcome, how = finished_run(job, out), "reused, "
    if outcome is None:
        with console.status(f"{escape(head)}; log: {escape(str(job.folder(out) / LOG_FILE))}"):
            outcome, how = run_job(job, out), ""
    print_plain(f"{head}: {how}{_short(outcome)}", console)
    return outcome


def command_of(job: Job) -> tuple[str, ...]:
    """What does the job, before the path of its file."""
    return (sys.executable, "-m", job.worker)


def run_job(job: Job, out: Path) -> Run | Failure:
    """Start the job's process and wait for it; Ctrl-C ends it, too."""
    folder = job.folder(out)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    write_json(folder / JOB_FILE, dataclasses.asdict(job))
    log = folder / LOG_FILE
    command = [*command_of(job), str(folder / JOB_FILE)]
    env = {**os.environ, "PYTHONUNBUFFERED": "1", "TERM": "dumb"}
    try:
        with (
            open(log, "wb") as stream,
            subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=stream, stderr=subprocess.STDOUT, env=env
            ) as process,
        ):
            try:
                code = process.wait()
            finally:
                process.terminate()  # on Ctrl-C; what has ended takes no notice
    finally:
        for name in job.scratch:
            shutil.rmtree(folder / name, ignore_errors=True)
    run = finished_run(job, out) if code == 0 else None
    return run or Failure(job.method, job.seed, _reason(code, log), str(log.relative_to(out)), job.variant)


def _reason(code: int, log: Path) -> str:
    if code < 0:
        hint = " (out of memory?)" if code == -signal.SIGKILL else ""
        return f"ended by {signal.Signals(-code).name}{hint}"
    lines = log.read_text("utf-8", "replace").splitlines()
    return next((line.strip() for line in reversed(lines) if line.strip()), f"exit code {code}")


def _short(outcome: Run | Failure) -> str:
    if isinstance(outcome, Failure):
        return f"failed: {outcome.reason} (see {outcome.log})"
    score = "" if outcome.psnr_merged is None else f"{outcome.psnr_merged:.2f} dB merged, "
    gpu = "" if outcome.peak_device_bytes is None else f", {outcome.peak_device_bytes / 2**30:.2f} GiB of GPU"
    done = f"{outcome.gaussians:,} Gaussians, {outcome.steps:,} steps in {outcome.train_seconds:.0f} s"
    return f"{score}{done}, {outcome.peak_rss_bytes / 2**30:.2f} GiB of RAM{gpu}"


def work(kind: type[Job], do: Callable[..., Run]) -> int:
    """In a job's process, whose only argument is the job's file: `do` it, given job and folder; returns 0, or
    2 for an error of the user's."""
    end_with_parent()
    (path,) = map(Path, sys.argv[1:])
    job = decode(kind, read_json(path), str(path))
    try:
        found = do(job, path.resolve().parent)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    write_json(path.with_name(RUN_FILE), dataclasses.asdict(found))
    return 0


def memory_of_run() -> dict[str, int | str | None]:
    """The most that this process has held, by the names of a run's fields."""
    allocated, reserved = peak_device_bytes()
    return {
        "peak_rss_bytes": peak_rss_bytes(),
        "peak_device_bytes": allocated,
        "peak_device_note": "no CUDA device" if allocated is None else None,
        "peak_reserved_bytes": reserved,
    }
