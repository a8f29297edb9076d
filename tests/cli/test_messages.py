"""No message names an option that no command has."""

import ast
import io
import re
from contextlib import redirect_stdout, suppress
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import tyro
from nerfstudio.scripts.viewer.run_viewer import RunViewer

from abcd_ns import methods
from abcd_ns.cli import main as cli
from abcd_ns.nerfstudio.dataparser import AbcdDataParserConfig

PACKAGE = Path(cli.__file__).parents[1]
FLAG = re.compile(r"(?<![\w-])--[a-zA-Z][\w.-]*\w")
ELSEWHERE = {"--ImageReader.single-camera", "--mask-color", "--at", "--output-path", "--version"}
"""Of colmap, of nerfstudio's reader nerfstudio-data, of the report's style, of ns-eval, and of `abcd`."""


@cache
def known_flags() -> set[str]:
    """The options of all commands, as their helps have them, and the beginnings of dotted ones."""
    commands: list[Any] = [command.load() for command in cli.COMMANDS if not command.passes_on]
    text, ns_train = io.StringIO(), methods.abcd.config
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(text):
        patch.setenv("COLUMNS", "400")
        for target in (*commands, RunViewer, AbcdDataParserConfig):
            with suppress(SystemExit):
                tyro.cli(target, args=["--help"])
        with suppress(SystemExit):
            tyro.cli(type(ns_train), args=["--help"], default=ns_train)
    flags = {flag.replace("_", "-") for flag in FLAG.findall(text.getvalue())} | ELSEWHERE
    return flags | {flag[:place] for flag in flags for place, letter in enumerate(flag) if letter == "."}


def unknown(source: str) -> list[str]:
    """Options that are named in the sentences of a source, and that no command has."""
    constants = (node.value for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Constant))
    sentences = [text for text in constants if isinstance(text, str) and " " in text]
    flags = {flag for text in sentences for flag in FLAG.findall(text)}
    return [flag for flag in sorted(flags) if flag.replace("_", "-") not in known_flags()]


def test_every_option_that_a_message_names_exists():
    rooms = ("cli", "data", "engine", "formats", "lab", "nerfstudio", "viewer")
    paths = [path for room in rooms for path in (PACKAGE / room).rglob("*.py")]
    assert {path.name: found for path in paths if (found := unknown(path.read_text()))} == {}
    assert unknown('f"Use --picturs {n}."') == ["--picturs"]
