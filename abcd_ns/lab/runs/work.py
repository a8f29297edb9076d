"""What all worker processes do: read a job, do it, write its run beside it."""

import sys
from collections.abc import Callable
from pathlib import Path

from abcd_ns.errors import UserError
from abcd_ns.lab.job import Job
from abcd_ns.lab.results.records import decode, encode, read_json, write_json
from abcd_ns.lab.results.run import Run
from abcd_ns.machine import peak_device_bytes, peak_rss_bytes

RUN_FILE = "run.json"
"""Written when all is done, beside the job."""


def work(kind: type[Job], do: Callable[..., Run]) -> int:
    """Do the job in the file named by the only argument; exit code 0, or 2 for an error of the user's.

    Args:
        do: given the job and its folder.
    """
    (path,) = map(Path, sys.argv[1:])
    job = decode(kind, read_json(path), str(path))
    try:
        found = do(job, path.resolve().parent)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    write_json(path.with_name(RUN_FILE), encode(found))
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
