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

RUNS_CODE = ("pickle", "cPickle", "dill", "cloudpickle", "joblib", "marshal", "shelve")
"""Modules whose files run code when they are read."""
ASKS_OUT = ("requests", "urllib.request", "http.client", "ftplib", "smtplib", "huggingface_hub", "gdown")

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


def skips_have_reasons(source: str) -> Iterator[str]:
    """A skipped or expected failure says why; a skipif is given its condition."""
    tree = ast.parse(source)
    called = {id(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call)}
    marks = ("pytest.mark.skip", "pytest.mark.skipif", "pytest.mark.xfail")
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and id(node) not in called and ast.unparse(node) in marks:
            yield f"{node.lineno}: bare {ast.unparse(node)}"
        if isinstance(node, ast.Call):
            name = ast.unparse(node.func)
            keywords = {keyword.arg for keyword in node.keywords}
            wants_reason = name in ("pytest.mark.skipif", "pytest.mark.xfail")
            takes_it_first = name in ("pytest.mark.skip", "pytest.skip", "pytest.xfail")
            if (wants_reason or (takes_it_first and not node.args)) and "reason" not in keywords:
                yield f"{node.lineno}: {name} without a reason"


def machine_independent(source: str) -> Iterator[str]:
    """No path of one machine."""
    for number, line in enumerate(source.splitlines(), 1):
        for path in re.findall(r"(?<![\w.~-])/(?:root|work|home/\w+|Users/\w+|opt/\w+)/[\w.-]*", line):
            yield f"{number}: {path}"


def no_index_hosts(source: str) -> Iterator[str]:
    """Where packages come from is the user's setting."""
    hosts = r"pypi\.org|pythonhosted\.org|download\.pytorch\.org|--(?:extra-)?index-url|--find-links|--hash"
    for number, line in enumerate(source.splitlines(), 1):
        for host in re.findall(hosts, line):
            yield f"{number}: {host}"


def no_circular_nerfstudio_imports(source: str) -> Iterator[str]:
    """nerfstudio loads our methods while importing method_configs: to ask for it again breaks every ns-*."""
    for node in ast.parse(source).body:
        imported = [ast.unparse(node)] if isinstance(node, (ast.Import, ast.ImportFrom)) else []
        for statement in imported:
            if re.search(
                r"nerfstudio\.(configs\.method_configs|scripts)|nerfstudio\.configs import method_", statement
            ):
                yield f"{node.lineno}: {statement}"


def unsafe(source: str) -> Iterator[str]:
    """Calls and imports by which a file could run code, or this program talk to a network."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and [alias.name for alias in node.names] == ["UnpicklingError"]:
            names = []  # to name an error is to load nothing
        elif isinstance(node, ast.ImportFrom):
            names = [node.module or "", *(f"{node.module}.{alias.name}" for alias in node.names)]
        else:
            names = []
        bad = [name for name in names if name.split(".")[0] in RUNS_CODE or name in ASKS_OUT]
        if bad:
            yield f"{node.lineno}: imports {bad[0]}"
        if isinstance(node, ast.Call):
            yield from _unsafe_call(node)


def _unsafe_call(node: ast.Call) -> Iterator[str]:
    called = ast.unparse(node.func)
    options = {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}
    if called == "torch.load" and options.get("weights_only") != "True":
        yield f"{node.lineno}: torch.load without weights_only=True"
    if options.get("allow_pickle") == "True":
        yield f"{node.lineno}: {called} with allow_pickle"
    if called in ("yaml.load", "yaml.unsafe_load", "yaml.full_load", "eval", "exec", "os.system", "os.popen"):
        yield f"{node.lineno}: {called}"
    if options.get("shell") == "True":
        yield f"{node.lineno}: {called} through a shell"


def complaints(rule: Rule, paths: list[Path]) -> list[str]:
    """What `rule` finds in the files, as path:line: text."""
    return [f"{path.relative_to(ROOT)}:{found}" for path in paths for found in rule(path.read_text())]


def config_files() -> list[Path]:
    """The files that configure, install or build, but no results and no environment."""
    wanted = {".toml", ".txt", ".cfg", ".ini", ".yml", ".yaml", ".sh"}
    top = [
        p
        for p in ROOT.iterdir()
        if p.suffix in wanted or p.name in ("Makefile", ".importlinter", ".gitignore")
    ]
    folders = [ROOT / name for name in (".ci", ".github", "docker", "scripts")]
    return sorted(top + [p for folder in folders for p in folder.rglob("*") if p.is_file()])


def text_files() -> list[Path]:
    """Config, documents and code; not this file, which has to name what it looks for."""
    documents = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]
    return [
        p for p in [*config_files(), *documents, *PACKAGE_FILES, *TEST_FILES] if p != Path(__file__).resolve()
    ]


@pytest.mark.parametrize(
    ("rule", "paths"),
    [
        (file_length, [*PACKAGE_FILES, *KERNEL_FILES, *TEST_FILES]),
        (function_length, [*PACKAGE_FILES, *TEST_FILES]),
        (skips_have_reasons, TEST_FILES),
        (machine_independent, text_files()),
        (no_index_hosts, config_files()),
        (unsafe, PACKAGE_FILES),
        (
            no_circular_nerfstudio_imports,
            [p for p in PACKAGE_FILES if not {"cli", "lab"} & set(p.relative_to(ROOT).parts)],
        ),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
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
