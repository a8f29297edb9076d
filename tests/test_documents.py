"""Commands in the documents are understood, links lead somewhere, numbers are those of runs and the code."""

import functools
import json
import re
import shlex
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import fmean
from typing import Any

import pytest
import tyro
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion
from nerfstudio.scripts.eval import ComputePSNR
from nerfstudio.scripts.exporter import Commands as Export
from nerfstudio.scripts.render import Commands as Render
from nerfstudio.scripts.viewer.run_viewer import RunViewer

from abcd_ns.cli import main as cli
from abcd_ns.cli import train
from abcd_ns.engine.train.memory import DeviceNeeds
from benchmarks.tables import PAGE, with_tables

ROOT = Path(__file__).resolve().parent.parent
DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
DOCUMENTS.append(ROOT / "docs" / "results" / "README.md")
TUTORIAL, REFERENCE = ((ROOT / "docs" / name).read_text() for name in ("tutorial.md", "reference.md"))
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
LINK = re.compile(r"\]\(([^)]+)\)|<img src=\"([^\"]+)\"")
NERFSTUDIO: dict[str, Any] = {
    "ns-train": AnnotatedBaseConfigUnion,
    "ns-eval": ComputePSNR,
    "ns-viewer": RunViewer,
    "ns-export": Export,
    "ns-render": Render,
}
BUDGETS = (4, 6, 8, 12, 24)
"""GiB."""
PHOTOS = (1, 2, 8)
"""Megapixels."""


def commands(text: str) -> Iterator[str]:
    """Lines of fenced or indented code that call one of the programs."""
    fenced = "\n".join(re.findall(r"^```(?:bash|sh)?\n(.*?)^```", text, re.DOTALL | re.MULTILINE))
    indented = "\n".join(re.findall(r"^    +(.*)$", text, re.MULTILINE))
    for line in f"{fenced}\n{indented}".replace("\\\n", " ").splitlines():
        if re.match(r"(abcd|ns-\w+) ", line.strip()):
            yield line.strip()


SHOWN = [
    pytest.param(line, id=f"{path.name}: {line}") for path in DOCUMENTS for line in commands(path.read_text())
]


def no_deed(function: Callable) -> Callable:
    """What is called as `function` is, and does nothing."""

    @functools.wraps(function)
    def nothing(*_: Any, **__: Any) -> None:
        pass

    return nothing


def parse(line: str) -> None:
    """Let the program read its options; SystemExit if it does not take them."""
    line = line.replace("--load-config ...", "--load-config config.yml").split(" > ")[0]
    program, *words = [word for word in shlex.split(line, comments=True) if word != "..."]
    if program in NERFSTUDIO:
        tyro.cli(NERFSTUDIO[program], args=words)
        return
    if words[0].startswith("--"):
        return
    command = {each.name: each for each in cli.COMMANDS}[words[0]]
    if command.passes_on:
        tyro.cli(AnnotatedBaseConfigUnion, args=[*train.command_line(Path(words[1])), *words[2:]])
        return
    tyro.cli(no_deed(command.load()), args=words[1:])


@pytest.mark.parametrize("line", SHOWN)
def test_a_command_in_the_documents_is_understood(line):
    parse(line)


def test_there_are_commands_to_look_at():
    assert {"ns-train", "abcd"} <= {shlex.split(p.values[0], comments=True)[0] for p in SHOWN}
    assert len(SHOWN) > 20


def anchors(text: str) -> set[str]:
    """What a link may name after its #."""
    prose = re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    headings = re.findall(r"^#+ (.+)$", prose, re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


def dead_links(path: Path) -> Iterator[str]:
    """Links of a page to files and headings of this repository that are not there."""
    for link in ("".join(found) for found in LINK.findall(path.read_text().replace("\n", " "))):
        name, _, anchor = link.partition("#")
        there = path.parent / name if name else path
        if "://" not in link and (
            not there.exists() or (anchor and anchor not in anchors(there.read_text()))
        ):
            yield link


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_to_files_and_headings(path):
    assert list(dead_links(path)) == []


def final_psnr(value: Any) -> Iterator[float]:
    """Held-out PSNR of every run in a JSON value, at its end, and the mean of every arm's."""
    if isinstance(value, dict) and isinstance(value.get("psnr_merged"), float):
        yield value["psnr_merged"]
    if isinstance(value, dict) and "variant" in value and "runs" in value:
        yield fmean(scores) if all(scores := [run["psnr_merged"] for run in value["runs"]]) else 0.0
    for each in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        yield from final_psnr(each)


def test_the_decibels_of_the_readme_are_of_stored_runs():
    stored = (ROOT / "docs" / "results").rglob("*.json")
    known = {f"{value:.2f}" for path in stored for value in final_psnr(json.loads(path.read_text()))}
    said = re.findall(r"(?<![\d.])\d\d\.\d\d(?!\d|\.\d)", (ROOT / "README.md").read_text())
    assert len(said) > 4
    assert [value for value in said if value not in known] == []


def test_the_tables_of_the_results_are_made_of_stored_runs():
    page = PAGE.read_text()
    assert page.count("<!-- table: ") >= 6
    assert with_tables(page, PAGE.parent) == page


def test_what_the_results_are_reproduced_by_is_understood():
    script = ROOT / "benchmarks" / "reproduce.sh"
    listed = subprocess.run([script], capture_output=True, text=True, check=True).stdout
    commands = re.findall(r"abcd (?:compare|stability) .*", listed)
    assert len(commands) > 15
    for command in commands:
        parse(f"{command} --out reproduced")


def memory_table() -> str:
    """Millions of Gaussians in a block; a dash where not even a small one fits."""
    lines = [
        "| photos | " + " | ".join(f"{budget} GiB" for budget in BUDGETS) + " |",
        "| --- |" + " ---: |" * len(BUDGETS),
    ]
    for megapixels in PHOTOS:
        needs = DeviceNeeds(megapixels * 10**6, batch=1, in_parts=True)
        limits = [needs.block_limit(budget << 30) / 1e6 for budget in BUDGETS]
        cells = [f"{limit:.1f} million" if limit > 0 else "-" for limit in limits]
        lines.append(f"| {megapixels} megapixels | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def test_what_a_gaussian_takes_is_what_the_reference_says():
    takes = [DeviceNeeds(1, batch=1, active_degree=degree, in_parts=True).gaussian_bytes for degree in (0, 3)]
    assert "takes {:,} bytes instead of {:,}".format(*takes) in REFERENCE.replace("\n", " ")
    assert f"up to {takes[1] / takes[0]:.1f} times as many" in TUTORIAL.replace("\n", " ")


def test_the_table_of_memory_is_that_of_the_model():
    shown = TUTORIAL.split("<!-- memory:begin -->\n")[1].split("\n<!-- memory:end -->")[0]
    assert shown == memory_table()
