"""`abcd train`: `ns-train` with its options from a TOML file."""

import os
import shutil
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from abcd_ns.errors import UserError
from abcd_ns.lab.results.records import read_toml

USAGE = """usage: abcd train FILE.toml [OPTIONS]

Run `ns-train` with the options of a TOML file. Options given here replace those of the file.

  abcd train cpu --data garden          # no GPU: a small model in 15 minutes
  abcd train small-gpu --data garden    # a small GPU, or a shared one
  abcd train mine.toml --data garden    # a file of your own

cpu, small-gpu and garden come with abcd. A file begins with the method of ns-train: method = "abcd".
Options stand in tables: --pipeline.blocks 8 is blocks = 8 in [pipeline].
docs/reference.md lists all options."""


def train(words: list[str]) -> int:
    """Take the place of this process with `ns-train`, by the file and options in `words`."""
    if not words or words[0] in ("-h", "--help"):
        print(USAGE)
        return 0
    command = [tool("ns-train"), *command_line(Path(words[0])), *words[1:]]
    os.execv(command[0], command)


def command_line(path: Path) -> list[str]:
    """What a file's options are on the command line of `ns-train`. A UserError if it is absent, is no TOML,
    names no method, or holds what no option can be."""
    data = read_toml(path, f"{path} does not exist.", trains=True)
    method = data.pop("method", None)
    if not isinstance(method, str):
        raise UserError(f'{path} names no method; begin it with: method = "abcd"')
    return [method, *_flags(data, "--", path)]


def _flags(table: Mapping[str, Any], prefix: str, path: Path) -> Iterator[str]:
    for name, value in table.items():
        if isinstance(value, Mapping):
            yield from _flags(value, f"{prefix}{name}.", path)
        elif isinstance(value, (str, int, float)):  # bool is an int
            yield from (prefix + name, str(value))
        else:
            raise UserError(f"{path}: {name} is a list or a date; an option has a single value.")


def find_tool(name: str) -> str | None:
    """The command of this name beside this Python, or else on the PATH."""
    return shutil.which(name, path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', '')}")


def tool(name: str) -> str:
    """As `find_tool`; UserError where there is none."""
    if (found := find_tool(name)) is None:
        raise UserError(f"There is no {name} here; install nerfstudio into this environment.")
    return found
