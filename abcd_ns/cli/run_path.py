"""Which folder a user means by a run."""

from pathlib import Path

from abcd_ns.data.input_errors import one_line
from abcd_ns.errors import UserError
from abcd_ns.nerfstudio.run import STATE


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
    if not path.is_dir():
        return "there is no such folder."
    below = sorted(path.glob(f"**/{STATE}/{name}"), key=lambda found: found.stat().st_mtime)
    if below:
        return f"did you mean {below[-1].parent.parent}?"
    return "give a folder outputs/SCENE/METHOD/TIME that this version of `ns-train abcd` wrote."
