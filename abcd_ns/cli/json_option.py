"""The option --json FILE of commands that report; refused before any work where nothing can be written."""

from pathlib import Path
from typing import Any

from abcd_ns.errors import UserError
from abcd_ns.lab.results.records import encode, write_json


def check_json(path: Path | None) -> None:
    """Whether a report could be written.

    Raises:
        UserError: `path` is a folder, or lies in none.
    """
    if path is None:
        return
    if path.is_dir():
        raise UserError(f"--json {path} is a folder; name a file.")
    if not path.parent.is_dir():
        raise UserError(f"--json {path}: the folder {path.parent} does not exist; make it first.")


def write_report(path: Path | None, report: Any) -> None:
    """Write a frozen dataclass; None writes nothing.

    Raises:
        UserError: the file cannot be written.
    """
    if path is None:
        return
    try:
        write_json(path, encode(report))
    except OSError as error:
        raise UserError(f"--json {path} cannot be written ({error.strerror}); name another file.") from None
