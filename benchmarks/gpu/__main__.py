"""All that is to be measured once there is a CUDA device, in parts, within 40 minutes.

    python -m benchmarks.gpu --data DIR --out OUT

Each part has a share of the time and a process of its own, which is killed when its time is over. OUT gets a
JSON file for each part and charts. A part that is there and whole is not run again.
"""

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from shutil import rmtree
from typing import Any, Literal

import torch
import tyro
from rich.console import Console

from abcd_ns.errors import UserError
from abcd_ns.lab.compare.charts import draw_charts
from abcd_ns.lab.results.records import decode, encode, read_json, write_json
from abcd_ns.lab.results.results import Results
from abcd_ns.lab.results.tables import notes, print_rows, rows
from abcd_ns.lab.runs.runner import last_line
from benchmarks.gpu.parts import NEED_DATA, PARTS, ROOT, Task

OUT = Path("docs/results/gpu")
WORKER = (sys.executable, "-m", "benchmarks.gpu.parts")


@dataclass
class Args:
    """What to do."""

    data: Path | None = None
    """The scene, as for `ns-train abcd --data`, at full size."""
    out: Path | None = None
    """Gets a JSON file a part, and charts; OUT/work is scratch. Default: docs/results/gpu; of a dry run, a
    temporary folder."""
    parts: tuple[Literal["build", "compare", "compare-steps", "extent", "visit"], ...] = tuple(PARTS)
    """Of these, in this order."""
    minutes: float = 40.0
    """For all of them; what a part leaves goes to those after it."""
    again: bool = False
    """Run these parts whether or not their files are there, from nothing."""
    dry_run: bool = False
    """Try the machinery where there is no CUDA device: tiny, on the CPU. Its numbers mean nothing."""
    seed: int = 0
    """Of every run."""


def main(args: Args) -> int:
    """Run what is missing; 1 if a part failed, 2 without a CUDA device."""
    if not (torch.cuda.is_available() or args.dry_run):
        print("There is no CUDA device here; --dry-run tries the machinery without one.")
        return 2
    out = args.out or (Path(tempfile.mkdtemp(prefix="gpu-dry-run-")) if args.dry_run else OUT)
    parts = [part for part in PARTS if part in args.parts]
    if args.data is None and NEED_DATA & set(parts):
        raise UserError(f"Give the scene with --data DIR, or --parts without {', '.join(sorted(NEED_DATA))}.")
    check_kind(parts, args, out)
    ends = time.monotonic() + 60 * args.minutes
    for number, part in enumerate(parts):
        path = out / f"{part}.json"
        if not args.again and path.exists() and not read_json(path)["error"]:
            print(f"{part}: {path} is there; --again runs it again", flush=True)
            continue
        shares = [PARTS[later][0] for later in parts[number:]]
        record = run_part(part, args, out, (ends - time.monotonic()) * shares[0] / sum(shares))
        print(
            f"{part}: {record['seconds']:.0f} s{', ' + record['error'] if record['error'] else ''}",
            flush=True,
        )
    records = [read_json(out / f"{part}.json") for part in PARTS if (out / f"{part}.json").exists()]
    show(records, out, Console())
    return int(any(record["error"] for record in records if record["part"] in parts))


def check_kind(parts: Sequence[str], args: Args, out: Path) -> None:
    """See that records of dry runs, whose numbers mean nothing, and of real ones do not mix.

    Raises:
        UserError: `out` has records of the other kind, and they are not made anew.
    """
    kept = [out / f"{part}.json" for part in PARTS if not (args.again and part in parts)]
    others = [path.stem for path in kept if path.exists() and read_json(path)["dry_run"] != args.dry_run]
    if others:
        kind = f"{'real' if args.dry_run else 'dry'} runs ({', '.join(others)})"
        raise UserError(f"--out {out} holds records of {kind}; name another folder, or use --again.")


def run_part(
    part: str, args: Args, out: Path, seconds: float, worker: Sequence[str] = WORKER
) -> dict[str, Any]:
    """Run a part for `seconds` at most; its record, which is also in OUT/PART.json.

    Args:
        worker: command that is given the path of the task.
    """
    path, work = out / f"{part}.json", out.resolve() / "work" / part
    if args.again:
        rmtree(work, ignore_errors=True)
    path.unlink(missing_ok=True)
    work.mkdir(parents=True, exist_ok=True)
    data = args.data and str(args.data.resolve())
    task = out.resolve() / "work" / f"{part}-task.json"
    write_json(task, encode(Task(part, str(out.resolve()), str(work), data, args.seed, args.dry_run)))
    began = time.monotonic()
    error = run_bounded([*worker, str(task)], seconds, task.with_name(f"{part}-log.txt"))
    record = read_json(path) if path.exists() else {"part": part, "dry_run": args.dry_run, "found": {}}
    record |= {"error": error, "seconds": round(time.monotonic() - began, 1)}
    record["date"] = datetime.now(timezone.utc).isoformat(timespec="seconds")
    write_json(path, record)
    return record


def run_bounded(command: Sequence[str], seconds: float, log: Path) -> str | None:
    """Run a command for `seconds` at most; why it came to nothing, or None. What it started ends with it."""
    with open(log, "wb") as said:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=said,
            stderr=subprocess.STDOUT,
            cwd=ROOT,
            env={**os.environ, "PYTHONUNBUFFERED": "1"},
            start_new_session=True,
        )
        try:
            code = process.wait(timeout=max(seconds, 0))
        except subprocess.TimeoutExpired:
            return f"killed after {seconds:.0f} s, the time it had"
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
    return None if code == 0 else last_line(log) or f"exit code {code}"


def show(records: Sequence[dict[str, Any]], out: Path, console: Console) -> None:
    """Draw the charts of experiments; print a table for each part, below it what went wrong."""
    for record in records:
        table, remarks = _rows(record["part"], record["found"])
        if (results := _results(record["found"])) is not None:
            remarks += map(str, draw_charts(results, out, f"{record['part']}-"))
        trouble = [f"{record['part']}: {record['error']}"] if record["error"] else []
        dry = ["a dry run: these numbers mean nothing"] if record["dry_run"] else []
        print_rows(table, [*dry, *remarks, *trouble], console)


def _rows(part: str, found: dict[str, Any]) -> tuple[list[list[str]], list[str]]:
    """A part's table, titles first, and notes."""
    if not found:
        return [[part]], []
    if (results := _results(found)) is not None:
        return rows(results), [*results.findings, *notes(results)]
    if part == "visit":
        columns = found["by_blocks"]
        titles = ["visit, ms a view", *(f"{column['blocks']} blocks" for column in columns)]
        stages = columns[0]["ms_per_view"] if columns else {}
        body = [[stage, *(f"{column['ms_per_view'][stage]:.2f}" for column in columns)] for stage in stages]
        return [titles, *body], []
    flat = {**found["hardware"], **{name: value for name, value in found.items() if name != "hardware"}}
    return [["build", ""], *([name, str(value)] for name, value in flat.items())], []


def _results(found: dict[str, Any]) -> Results | None:
    """Of a part that is an experiment."""
    return decode(Results, found["results"], "results") if found.get("results") else None


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that what was started ends too
    try:
        sys.exit(main(tyro.cli(Args)))
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
