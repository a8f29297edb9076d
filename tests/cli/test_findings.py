"""Findings: how they look in a terminal, and that the document explains each of them."""

import ast
import io
import re
from pathlib import Path

from rich.console import Console

from abcd_ns.cli.findings import Finding, print_findings

ROOT = Path(__file__).resolve().parents[2]
DOCUMENT = (ROOT / "docs/troubleshooting.md").read_text()
MAKERS = [*(ROOT / "abcd_ns/cli/check").glob("*.py"), *(ROOT / "abcd_ns/cli/doctor").glob("*.py")]


def printed(*findings: Finding, width: int = 80) -> list[str]:
    stream = io.StringIO()
    print_findings(findings, Console(file=stream, width=width))
    return stream.getvalue().splitlines()


def test_groups_are_titled_and_long_ones_cut():
    name, long = "[red]a.png[/red] :smile:", [Finding("note", str(i), "Too.") for i in range(30)]
    lines = printed(Finding("note", "n", name), Finding("error", "e", "Bad."), *long)
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


def names_in_document() -> set[str]:
    headings = re.findall(r"^#### (.+)$", DOCUMENT, re.MULTILINE)
    return {name for heading in headings for name in heading.split(", ")}


def test_the_document_explains_every_finding_and_no_other():
    assert len(names_in_code()) > 30
    assert names_in_document() == names_in_code()
