"""The rules of the house (CONTRIBUTING.md), as far as a machine can check them and ruff does not."""

import ast
import re
import sys
from collections.abc import Callable, Iterator
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

import abcd_ns

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # comes with pytest on 3.10

ROOT = Path(__file__).resolve().parent.parent
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PACKAGE_FILES = sorted((ROOT / "abcd_ns").rglob("*.py"))
KERNEL_FILES = sorted((ROOT / "abcd_ns/engine/kernels/cpp").iterdir())
TEST_FILES = sorted((ROOT / "tests").rglob("*.py"))

MAX_FILE_LINES = 400
MAX_FUNCTION_LINES = 60

Rule = Callable[[str], Iterator[str]]
_FUNCTION = (ast.FunctionDef, ast.AsyncFunctionDef)


def file_length(source: str) -> Iterator[str]:
    """A file is read in one sitting."""
    lines = len(source.splitlines())
    if lines > MAX_FILE_LINES:
        yield f"1: {lines} lines, more than {MAX_FILE_LINES}"


def function_length(source: str) -> Iterator[str]:
    """A function is read on one screen."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, _FUNCTION) and node.end_lineno - node.lineno >= MAX_FUNCTION_LINES:
            yield f"{node.lineno}: {node.name} has {node.end_lineno - node.lineno + 1} lines"


def without(pattern: str) -> Rule:
    """No line in which the pattern is."""

    def rule(source: str) -> Iterator[str]:
        for number, line in enumerate(source.splitlines(), 1):
            for found in re.finditer(pattern, line):
                yield f"{number}: {found[0]}"

    return rule


MACHINE_PATHS = r"(?<![\w.~-])/(?:root|work|home/\w+|Users/\w+|opt/\w+)/[\w.-]*"
INDEX_HOSTS = r"pypi\.org|pythonhosted\.org|download\.pytorch\.org|--(?:extra-)?index-url|--find-links|--hash"
"""Where packages come from is the user's setting."""
RUNS_CODE = r"torch\.load\((?!.*weights_only=True)|allow_pickle=True"
"""Reads of files that may run code, as far as ruff does not look for them."""
NO_REASON = r"pytest\.(mark\.)?(skip|xfail)(\(\)|(?![\w(]))"


def complaints(rule: Rule, paths: list[Path]) -> list[str]:
    """What `rule` finds in the files, as path:line: text."""
    return [f"{path.relative_to(ROOT)}:{found}" for path in paths for found in rule(path.read_text())]


def config_files() -> list[Path]:
    """The files that configure, install or build, but no results and no environment."""
    wanted = {".toml", ".txt", ".cfg", ".ini", ".yml", ".yaml", ".sh"}
    names = {"Makefile", ".importlinter", ".gitignore"}
    top = [path for path in ROOT.iterdir() if path.suffix in wanted or path.name in names]
    folders = [ROOT / name for name in (".ci", ".github", "docker", "scripts")]
    return sorted(top + [p for folder in folders for p in folder.rglob("*") if p.is_file()])


def text_files() -> list[Path]:
    """Config, documents and code; not this file, which has to name what it looks for."""
    documents = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]
    found = [*config_files(), *documents, *PACKAGE_FILES, *TEST_FILES]
    return [path for path in found if path != Path(__file__).resolve()]


@pytest.mark.parametrize(
    ("rule", "paths"),
    [
        pytest.param(file_length, [*PACKAGE_FILES, *KERNEL_FILES, *TEST_FILES], id="file_length"),
        pytest.param(function_length, [*PACKAGE_FILES, *TEST_FILES], id="function_length"),
        pytest.param(without(NO_REASON), TEST_FILES, id="skips_have_reasons"),
        pytest.param(without(MACHINE_PATHS), text_files(), id="machine_independent"),
        pytest.param(without(INDEX_HOSTS), config_files(), id="no_index_hosts"),
        pytest.param(without(RUNS_CODE), PACKAGE_FILES, id="unsafe"),
        pytest.param(without(r"\b[MG]B\b"), PACKAGE_FILES, id="bytes_by_powers_of_1024"),
    ],
)
def test_the_house_is_clean(rule, paths):
    assert paths
    assert complaints(rule, paths) == []


def entry_points() -> list[str]:
    """Every "module:name" that installing the package announces."""
    project = PYPROJECT["project"]
    groups = [project["scripts"], *project["entry-points"].values()]
    return [target for group in groups for target in group.values()]


@pytest.mark.parametrize("target", entry_points())
def test_entry_points_exist(target):
    assert EntryPoint("", target, "").load()


def test_versions_agree():
    version = PYPROJECT["project"]["version"]
    assert abcd_ns.__version__ == version
    headings = re.findall(r"^## \[(.+?)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert headings[0] == version


def test_the_pinned_set_is_names_and_versions_and_complete():
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if not line.startswith("#")]
    pin = re.compile(r"([a-z0-9-]+)==[0-9][\w.]*( ; python_full_version .+)?")
    assert [line for line in lines if not pin.fullmatch(line)] == []

    project = PYPROJECT["project"]
    wanted = [*project["dependencies"], *project["optional-dependencies"]["dev"]]
    names = {re.match(r"[\w-]+", requirement).group().lower() for requirement in wanted}
    assert names - {line.split("==")[0] for line in lines} == set()
