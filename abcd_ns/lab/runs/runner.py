"""Runs jobs one after the other, each in a process of its own, and keeps what earlier calls finished."""

import dataclasses
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from abcd_ns.errors import UserError
from abcd_ns.lab.runs.job import Job, Plan, Settings
from abcd_ns.lab.runs.records import RecordError, decode, encode, read_json, write_json
from abcd_ns.lab.runs.run import Failure, Run
from abcd_ns.nerfstudio.machine import Machine

JOB_FILE, RUN_FILE, LOG_FILE = "job.json", "run.json", "log.txt"
WORKER = (sys.executable, "-m", "abcd_ns.lab.runs.worker")
POLL_SECONDS = 0.2
SECONDS_BETWEEN_LINES = 30.0
"""Where the output is no terminal, a line says this often that a run is still going on."""


@dataclasses.dataclass(frozen=True)
class Claim:
    """Under what a folder's runs were made."""

    settings: Settings
    machine: Machine


def claim_file(kind: str) -> str:
    """The file that marks a folder of such results and holds what all its runs share."""
    return f"{kind.replace(' ', '-')}.json"


def claim(out: Path, plan: Plan, machine: Machine, overwrite: bool) -> None:
    """Make `out` the folder of this plan's runs.

    Args:
        overwrite: drop the runs that are there.

    Raises:
        UserError: `out` holds something else, or runs under another protocol or from another machine.
    """
    mine = Claim(plan.settings, machine)
    if out.exists() and not out.is_dir():
        raise UserError(f"--out {out} is a file; name a folder.")
    path = out / claim_file(plan.kind)
    if not path.exists():
        if out.is_dir() and any(out.iterdir()):
            raise UserError(f"--out {out} is not empty and holds no {plan.kind}; name another folder.")
        out.mkdir(parents=True, exist_ok=True)
    elif overwrite:
        shutil.rmtree(out / "runs", ignore_errors=True)
    else:
        _check_same(decode(Claim, read_json(path), str(path)), mine, out)
    write_json(path, encode(mine))


def _check_same(theirs: Claim, mine: Claim, out: Path) -> None:
    for part in ("settings", "machine"):
        old, new = (vars(getattr(claim, part)) for claim in (theirs, mine))
        for name in new:
            if old[name] != new[name]:
                raise UserError(
                    f"--out {out} holds runs with {name} {old[name]}, not {new[name]}, which cannot be "
                    "compared; name another folder, or drop them with --overwrite."
                )


def finished_run(job: Job, out: Path) -> Run | None:
    """The run of the very same job that an earlier call finished, if any."""
    folder = job.folder(out)
    try:
        if decode(Job, read_json(folder / JOB_FILE), str(folder)) != job:
            return None
        return decode(Run, read_json(folder / RUN_FILE), str(folder / RUN_FILE))
    except RecordError:
        return None  # unfinished, or of another version of this program: to be run again


def run_jobs(plan: Plan, console: Console, worker: Sequence[str] = WORKER) -> list[Run | Failure]:
    """Finish all jobs of the plan, in order; a run that fails does not stop the others.

    Args:
        worker: command that is given the path of a job file.
    """
    found: list[Run | Failure] = []
    for number, job in enumerate(plan.jobs, start=1):
        head = f"[{number}/{len(plan.jobs)}] {job.name}"
        outcome = finished_run(job, plan.out)
        if outcome is not None:
            console.print(f"{head}: reused, {_short(outcome)}", markup=False, highlight=False)
        else:
            outcome = run_job(job, plan.out, console, head, worker)
            console.print(f"{head}: {_short(outcome)}", markup=False, highlight=False, soft_wrap=True)
        found.append(outcome)
    return found


def run_job(
    job: Job, out: Path, console: Console, head: str, worker: Sequence[str] = WORKER
) -> Run | Failure:
    """Start the job's process and wait for it."""
    folder = job.folder(out)
    if folder.exists():
        shutil.rmtree(folder)
    folder.mkdir(parents=True)
    write_json(folder / JOB_FILE, encode(job))
    log = folder / LOG_FILE
    with open(log, "wb") as stream:
        process = subprocess.Popen(
            [*worker, str(folder / JOB_FILE)],
            stdin=subprocess.DEVNULL,
            stdout=stream,
            stderr=subprocess.STDOUT,
            env={**os.environ, "PYTHONUNBUFFERED": "1", "TERM": "dumb"},
        )
        try:
            _wait(process, log, console, head)
        finally:
            if process.poll() is None:  # Ctrl-C
                process.terminate()
                process.wait()
    run = finished_run(job, out) if process.returncode == 0 else None
    reason = _reason(process.returncode, log)
    return run or Failure(job.method, job.seed, reason, str(log.relative_to(out)), job.variant.name)


def last_line(log: Path) -> str:
    """The last line with anything in it, or ""."""
    with open(log, "rb") as stream:
        stream.seek(max(0, log.stat().st_size - 8192))
        lines = stream.read().decode("utf-8", "replace").replace("\r", "\n").splitlines()
    return next((line.strip() for line in reversed(lines) if line.strip()), "")


def _wait(process: subprocess.Popen, log: Path, console: Console, head: str) -> None:
    began = told = time.monotonic()
    with console.status(head) as status:
        while process.poll() is None:
            time.sleep(POLL_SECONDS)
            now = time.monotonic()
            text = f"{head}: {now - began:.0f} s  {last_line(log)[:80]}"
            status.update(text.replace("[", r"\["))
            if not console.is_terminal and now - told > SECONDS_BETWEEN_LINES:
                told = now
                console.print(text, markup=False, highlight=False, soft_wrap=True)


def _reason(code: int, log: Path) -> str:
    if code < 0:
        hint = " (out of memory?)" if code == -signal.SIGKILL else ""
        return f"ended by {signal.Signals(-code).name}{hint}"
    return last_line(log) or f"exit code {code}"


def _short(outcome: Run | Failure) -> str:
    if isinstance(outcome, Failure):
        return f"failed: {outcome.reason} (see {outcome.log})"
    return (
        f"{outcome.psnr_merged:.2f} dB merged, {outcome.gaussians:,} Gaussians, {outcome.steps:,} steps in "
        f"{outcome.train_seconds:.0f} s"
    )
