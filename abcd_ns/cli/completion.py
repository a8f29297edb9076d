"""`abcd completion`: what a shell needs to complete this command's words."""

from typing import Annotated, Literal

import tyro

from abcd_ns.cli import main as cli


def completion(shell: Annotated[Literal["bash", "zsh"], tyro.conf.Positional] = "bash", /) -> None:
    """Print a script that completes commands and options of `abcd` in a shell.

    abcd completion bash > ~/.local/share/bash-completion/completions/abcd

    abcd completion zsh > ~/.zfunc/_abcd

    Args:
        shell: whose language the script is in.
    """
    functions = {command.name: command.load() for command in cli.COMMANDS if not command.passes_on}
    tyro.extras.subcommand_cli_from_dict(
        functions, prog="abcd", args=["--tyro-print-completion", shell], sort_subcommands=False
    )
