"""No message names an option that the command in question does not have."""

import ast
import io
import re
from collections.abc import Iterator
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
COMMANDS = {command.name: command for command in cli.COMMANDS if not command.passes_on}
ELSEWHERE = {"--ImageReader.single-camera", "--mask-color", "--at", "--output-path"}
"""Of the program colmap, of nerfstudio's reader nerfstudio-data, of the report's style, and of ns-eval."""
NERFSTUDIO = {"ns-train": methods.abcd.config, "ns-viewer": RunViewer, "abcd-data": AbcdDataParserConfig}


@cache
def flags_of(name: str) -> set[str]:
    """Every option of a program, as its help has them."""
    target: Any = COMMANDS[name].load() if name in COMMANDS else NERFSTUDIO[name]
    default = {"default": target} if name == "ns-train" else {}
    text = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(text), suppress(SystemExit):
        patch.setenv("COLUMNS", "400")
        tyro.cli(type(target) if default else target, args=["--help"], **default)
    return {flag.replace("_", "-") for flag in FLAG.findall(text.getvalue())}


def messages(source: str) -> Iterator[str]:
    """Every text; parts of f-strings that are not known are "{}"."""
    inside: set[int] = set()  # parts come after their f-string
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.JoinedStr):
            parts = [part.value if isinstance(part, ast.Constant) else "{}" for part in node.values]
            inside |= {id(part) for part in node.values}
            yield "".join(map(str, parts))
        elif isinstance(getattr(node, "value", None), str) and id(node) not in inside:
            yield node.value


def unknown(source: str, own: set[str]) -> list[str]:
    """Options in messages that neither `own` has, nor a program that the message names."""
    found = []
    for text in messages(source):
        named = [name for name in COMMANDS if f"abcd {name}" in text]
        named += [name for name in NERFSTUDIO if name in text]
        known = own.union(ELSEWHERE, *(flags_of(name) for name in named))
        known |= {flag[:place] for flag in known for place, letter in enumerate(flag) if letter == "."}
        flags = FLAG.findall(text) if " " in text else []  # else it is a word of a command line
        found += [f"{flag} in {text!r}" for flag in flags if flag.replace("_", "-") not in known]
    return found


def own_flags(path: Path) -> set[str]:
    """Of the commands that show the messages of a file. Dotted ones are `ns-train`'s wherever they stand."""
    dotted = {flag for flag in flags_of("ns-train") if "." in flag}
    room, *names = path.relative_to(PACKAGE).parts
    if room == "formats":
        return flags_of("export")
    if room not in ("cli", "lab"):
        return flags_of("ns-train") | flags_of("abcd-data")
    name = names[0].removesuffix(".py")
    of = [name] if name in COMMANDS else ["compare", "stability", "synth"] if room == "lab" else [*COMMANDS]
    return dotted.union(*map(flags_of, of))


@pytest.mark.parametrize("room", ["cli", "data", "engine", "formats", "lab", "nerfstudio", "viewer"])
def test_every_option_that_a_message_names_exists(room):
    paths = sorted((PACKAGE / room).rglob("*.py"))
    assert [f"{p.name}: {said}" for p in paths for said in unknown(p.read_text(), own_flags(p))] == []


def test_an_option_of_another_command_would_be_noticed():
    assert unknown('f"Use --pictures {n}."', flags_of("plan")) == ["--pictures in 'Use --pictures {}.'"]
    assert unknown('"`abcd report --pictures 3` does."', flags_of("plan")) == []
