"""Which folder a user means by a run."""

from itertools import chain
from pathlib import Path

from abcd_ns.data.input_errors import one_line
from abcd_ns.errors import UserError
from abcd_ns.run import STATE

LEVELS = 3
"""A run is that many folders below the outputs: SCENE/METHOD/TIME."""


def find_run(path: Path, *holds: str) -> Path:
    """The folder of a run that is named by it or by its config.yml.

    Args:
        holds: what is wanted of it, by its name in the run's folder STATE.

    Raises:
        UserError: there is none; the message says what to give.
    """
    path = path.parent if path.name == "config.yml" else path
    for name in holds:
        if not (path / STATE / name).exists():
            raise UserError(one_line(f"{path} is no run with {STATE}/{name}: {_hint(path, name)}"))
    return path


def _hint(path: Path, name: str) -> str:
    if not path.exists():
        return "there is no such folder. If the run was moved, give its new folder."
    wanted = f"{STATE}/{name}"
    above = [parent for parent in path.absolute().parents if (parent / wanted).exists()]
    below = chain.from_iterable(path.glob("*/" * level + wanted) for level in range(1, LEVELS + 1))
    newest = max(below, key=lambda found: found.stat().st_mtime, default=None)
    if above or newest is not None:
        return f"did you mean {above[0] if above else newest.parents[1]}?"
    return "give a folder outputs/SCENE/METHOD/TIME that this version of `ns-train abcd` wrote."
