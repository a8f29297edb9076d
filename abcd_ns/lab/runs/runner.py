"""Runs jobs one after the other, each in a process of its own, and keeps what earlier calls finished."""

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console

from abcd_ns.errors import UserError
from abcd_ns.lab.job import Job
from abcd_ns.lab.results.records import RecordError, decode, encode, read_json, write_json
from abcd_ns.lab.results.run import Failure, Run
from abcd_ns.lab.runs.work import RUN_FILE

JOB_FILE, LOG_FILE = "job.json", "log.txt"
POLL_SECONDS = 0.2
SECONDS_BETWEEN_LINES = 30.0
"""Where the output is no terminal, a line says this often that a run is still going on."""


def claim(out: Path, kind: str, shared: Mapping[str, Any], overwrite: bool = False) -> None:
    """Make `out` the folder of an experiment's results.

    Args:
        kind: of the experiment, in words.
        shared: what all its runs have in common, by part and name: values of JSON's.
        overwrite: drop the runs that are there.

    Raises:
        UserError: `out` holds something else, or runs that do not share that, or cannot be written.
    """
    marker = out / f"{kind.replace(' ', '-')}.json"
    with taking(out):
        if take_folder(out, marker, kind) and overwrite:
            shutil.rmtree(out / "runs", ignore_errors=True)
        elif marker.exists():
            _check_same(read_json(marker), shared, out)
        write_json(marker, dict(shared))


@contextmanager
def taking(out: Path) -> Iterator[None]:
    """Around what makes a user's folder one of ours and marks it.

    Raises:
        UserError: the operating system does not let it.
    """
    try:
        yield
    except OSError as error:
        raise UserError(f"{out} cannot be written: {error.strerror}; name another folder.") from None


def take_folder(out: Path, marker: Path, kind: str) -> bool:
    """Whether `out` is there already, with its marker; it is made where it is absent.

    Raises:
        UserError: it is a file, or a folder of something else.
    """
    if out.exists() and not out.is_dir():
        raise UserError(f"{out} is a file; name a folder.")
    if not marker.exists() and out.is_dir() and any(out.iterdir()):
        raise UserError(f"{out} is not empty and holds no {kind}; name another folder.")
    out.mkdir(parents=True, exist_ok=True)
    return marker.exists()


def _check_same(theirs: Any, mine: Mapping[str, Any], out: Path) -> None:
    for part, values in mine.items():
        for name, new in values.items():
            old = theirs.get(part, {}).get(name) if isinstance(theirs, dict) else None
            if old != new:
                raise UserError(
                    f"--out {out} holds runs with {name} {old}, not {new}, which cannot be "
                    "compared; name another folder, or drop them with --overwrite."
                )


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
        outcome, how = run_job(job, out, console, head), ""
    console.print(
        f"{head}: {how}{_short(outcome)}", markup=False, emoji=False, highlight=False, soft_wrap=True
    )
    return outcome


def command_of(job: Job) -> tuple[str, ...]:
    """What does the job, before the path of its file."""
    return (sys.executable, "-m", job.worker)


def run_job(job: Job, out: Path, console: Console, head: str) -> Run | Failure:
    """Start the job's process and wait for it."""
    folder = job.folder(out)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    write_json(folder / JOB_FILE, encode(job))
    log = folder / LOG_FILE
    with open(log, "wb") as stream:
        process = subprocess.Popen(
            [*command_of(job), str(folder / JOB_FILE)],
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
            for name in job.scratch:
                shutil.rmtree(folder / name, ignore_errors=True)
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
                console.print(text, markup=False, emoji=False, highlight=False, soft_wrap=True)


def _reason(code: int, log: Path) -> str:
    if code < 0:
        hint = " (out of memory?)" if code == -signal.SIGKILL else ""
        return f"ended by {signal.Signals(-code).name}{hint}"
    return last_line(log) or f"exit code {code}"


def _short(outcome: Run | Failure) -> str:
    if isinstance(outcome, Failure):
        return f"failed: {outcome.reason} (see {outcome.log})"
    score = "" if outcome.psnr_merged is None else f"{outcome.psnr_merged:.2f} dB merged, "
    gpu = "" if outcome.peak_device_bytes is None else f", {outcome.peak_device_bytes / 2**30:.2f} GiB of GPU"
    done = f"{outcome.gaussians:,} Gaussians, {outcome.steps:,} steps in {outcome.train_seconds:.0f} s"
    return f"{score}{done}, {outcome.peak_rss_bytes / 2**30:.2f} GiB of RAM{gpu}"
