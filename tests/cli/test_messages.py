"""Messages: none names an option that no command has; findings look as they should, and are documented."""

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
from rich.console import Console

from abcd_ns import methods
from abcd_ns.cli import main as cli
from abcd_ns.cli.findings import Finding, print_findings
from abcd_ns.nerfstudio.dataparser import AbcdDataParserConfig

PACKAGE = Path(cli.__file__).parents[1]
DOCUMENT = (PACKAGE.parent / "docs/troubleshooting.md").read_text()
MAKERS = [*(PACKAGE / "cli/check").glob("*.py"), PACKAGE / "cli/doctor.py"]
FLAG = re.compile(r"(?<![\w-])--[a-zA-Z][\w.-]*\w")
ELSEWHERE = {"--ImageReader.single-camera", "--mask-color", "--at", "--output-path", "--version"}
"""Of colmap, of nerfstudio's reader nerfstudio-data, of the report's style, of ns-eval, and of `abcd`."""


def help_of(target: Any, columns: int, **options: Any) -> str:
    text = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(text), suppress(SystemExit):
        patch.setenv("COLUMNS", str(columns))
        tyro.cli(target, args=["--help"], **options)
    return text.getvalue()


def commands() -> list[Any]:
    return [command.load() for command in cli.COMMANDS if not command.passes_on]


@cache
def known_flags() -> set[str]:
    """The options of all commands, as their helps have them, and the beginnings of dotted ones."""
    ns_train = methods.abcd.config
    helps = [help_of(target, 400) for target in (*commands(), RunViewer, AbcdDataParserConfig)]
    helps.append(help_of(type(ns_train), 400, default=ns_train))
    flags = {flag.replace("_", "-") for text in helps for flag in FLAG.findall(text)} | ELSEWHERE
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


def test_no_help_begins_a_line_within_a_sentence():
    """tyro breaks lines where docstrings have them."""
    lines = [line for target in commands() for line in help_of(target, 160).splitlines()]
    assert [line for line in lines if re.match(r" {6,}[a-z]", line)] == []


def test_groups_are_titled_and_long_ones_cut():
    name = "[red]a.png[/red] :smile:"
    findings = [Finding("note", "n", name), Finding("error", "e", "Bad.")]
    findings += [Finding("note", str(i), "Too.") for i in range(30)]
    stream = io.StringIO()
    print_findings(findings, Console(file=stream, width=80))
    lines = stream.getvalue().splitlines()
    assert lines[:5] == ["", "error", "  e: Bad.", "", "notes (31)"]
    assert lines[5] == f"  n: {name}"  # names of files are no markup
    assert lines[24:] == ["  18: Too.", "  ... and 11 more (31 in all)."]


def names_in_code() -> set[str]:
    nodes = (node for path in MAKERS for node in ast.walk(ast.parse(path.read_text())))
    calls = [(node.func, node.args) for node in nodes if isinstance(node, ast.Call)]
    # Of `(error if ... else warning)(name)`, either.
    calls = [(ast.unparse(getattr(maker, "body", maker)), args) for maker, args in calls]
    place = {"Finding": 1, "error": 0, "warning": 0, "note": 0}
    return {args[place[maker]].value for maker, args in calls if maker in place}


def test_the_document_explains_every_finding_and_no_other():
    headings = re.findall(r"^#### (.+)$", DOCUMENT, re.MULTILINE)
    assert len(names_in_code()) > 30
    assert {name for heading in headings for name in heading.split(", ")} == names_in_code()
