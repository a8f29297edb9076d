"""The `abcd` command: imports the subcommand that is called, and nothing else."""

import difflib
import errno
import importlib
import os
import signal
import sys
from collections.abc import Callable, Sequence
from typing import NamedTuple

from abcd_ns import __version__
from abcd_ns.errors import UserError, missing


class Command(NamedTuple):
    """A subcommand: `target` is the "module:function" that tyro makes a command line of.

    A module takes a second or two. It imports nerfstudio, which takes longer, where the options are right.
    The function may return an exit code; None is 0. It raises UserError where an option is out of range, what
    it is given cannot be used, or what it shall write is there already.
    """

    name: str
    target: str
    help: str
    passes_on: bool = False  # whether the function parses its words by itself

    def load(self) -> Callable[..., int | None]:
        module, function = self.target.split(":")
        return getattr(importlib.import_module(module), function)


COMMANDS = (
    Command("demo", "abcd_ns.cli.demo:demo", "make a small scene, train it, show the result"),
    Command("doctor", "abcd_ns.cli.doctor:doctor", "examine this machine and its packages"),
    Command("poses", "abcd_ns.cli.poses:poses", "find the camera poses of photos, by pycolmap"),
    Command("check", "abcd_ns.cli.check.command:check", "examine a data set before training"),
    Command("plan", "abcd_ns.cli.plan.command:plan", "predict blocks, memory and time of a run"),
    Command("train", "abcd_ns.cli.train:train", "run ns-train with options from a TOML file", passes_on=True),
    Command("report", "abcd_ns.cli.report.command:report", "write an HTML page about a run"),
    Command("export", "abcd_ns.cli.export:export", "write a scene as .ply, .spz, .sog or .glb"),
    Command("mesh", "abcd_ns.cli.mesh.command:mesh", "write a scene's surface as triangles"),
    Command("compare", "abcd_ns.lab.compare.command:compare", "compare methods, numbers of blocks, options"),
    Command("stability", "abcd_ns.lab.stability.command:stability", "run small scenes on which methods fail"),
)

HELP = """usage: abcd COMMAND [OPTIONS]

Train 3D Gaussian Splatting scenes larger than the GPU, one block at a time.

commands:
{commands}

options:
  --help      show this text, or after a command its options
  --version   show the version

examples:
  abcd demo                     see it work, without a GPU or data
  abcd check --data garden      see whether your photos can be trained on
  ns-train abcd --data garden   train on them
  abcd train cpu --data garden  train without a GPU
  abcd report --help            the options of one command"""


def run_command(name: str, args: list[str]) -> int:
    """Run a command on its own arguments; returns its exit code. Wrong arguments raise SystemExit(2), and a
    name that no command has a UserError that offers the nearest."""
    by_name = {command.name: command for command in COMMANDS}
    if name not in by_name:
        close = difflib.get_close_matches(name, by_name, n=1)
        hint = f"did you mean 'abcd {close[0]}'?" if close else f"there are: {', '.join(by_name)}."
        raise UserError(f"abcd has no command {name!r}; {hint}")
    function = by_name[name].load()
    if by_name[name].passes_on:
        return function(args)
    import tyro  # `abcd --help` has no use for it

    return tyro.cli(function, prog=f"abcd {name}", args=args) or 0


def main(args: Sequence[str] | None = None) -> int:
    """Entry point of `abcd`. `args` are the words after it; None takes them from the command line.

    Returns the exit code: 0, what the command returned, 2 for an error of the user's, 130 after Ctrl-C.
    """
    first, *others = (sys.argv[1:] if args is None else args) or ["--help"]
    for stream in filter(None, (sys.stdout, sys.stderr)):
        if stream.errors == "strict":  # names of files may have characters that the terminal lacks
            stream.reconfigure(errors="backslashreplace")
    code = 0
    try:
        if first in ("--help", "-h"):
            print(HELP.format(commands="\n".join(f"  {each.name:<12}{each.help}" for each in COMMANDS)))
        elif first == "--version":
            print(f"abcd {__version__}")
        else:
            code = run_command(first, others)
        print(end="", flush=True)
        return code
    except BrokenPipeError:  # `abcd ... | head`; at its end Python would flush once more
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + signal.SIGPIPE
    except UserError as error:
        message = str(error)
    except ImportError as error:
        if (error.name or "").startswith("abcd_ns"):
            raise
        message = missing(error)
    except OSError as error:
        is_full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        if error.filename is None and not is_full:
            raise
        fault = f"used: {error.strerror}."
        if is_full:
            fault = f"written: {error.strerror}; make room or write elsewhere."
        message = f"{error.filename or 'The output'} cannot be {fault}"
    except KeyboardInterrupt:
        return 128 + signal.SIGINT
    from rich.console import Console  # `abcd --help` has no use for it

    from abcd_ns.terminal import print_plain

    print_plain(f"error: {message}", Console(stderr=True), "red")
    return 2


if __name__ == "__main__":
    sys.exit(main())
