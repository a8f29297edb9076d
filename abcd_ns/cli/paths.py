"""Paths that users give: the folder of a run, and files to write."""

from itertools import chain
from pathlib import Path

from abcd_ns.data.input_errors import one_line
from abcd_ns.errors import UserError
from abcd_ns.run import STATE


def find_run(path: Path, holds: str) -> Path:
    """The folder of a run that is named by it or by its config.yml, and has `holds` in its folder STATE. A
    UserError says what to give instead."""
    path, wanted = path.parent if path.name == "config.yml" else path, f"{STATE}/{holds}"
    if (path / wanted).exists():
        return path
    hint = "give a folder outputs/SCENE/METHOD/TIME that this version of `ns-train abcd` wrote."
    above = (parent for parent in path.absolute().parents if (parent / wanted).exists())
    below = chain.from_iterable(path.glob("*/" * level + wanted) for level in (1, 2, 3))
    newest = sorted(below, key=lambda found: found.stat().st_mtime, reverse=True)
    if not path.exists():
        hint = "there is no such folder. If the run was moved, give its new folder."
    elif near := next(chain(above, (found.parents[1] for found in newest)), None):
        hint = f"did you mean {near}?"
    raise UserError(one_line(f"{path} is no run with {wanted}: {hint}"))


def check_file(option: str, path: Path) -> None:
    """Refuse, before any work, a `path` that is a folder or lies in none; a UserError."""
    if path.is_dir():
        raise UserError(f"{option} {path} is a folder; name a file.")
    if not path.parent.is_dir():
        raise UserError(f"{option} {path}: the folder {path.parent} does not exist; make it first.")
