"""The rules of the house (CONTRIBUTING.md), as far as a machine can check them and ruff does not.

Every rule is a function from source text to complaints, so that each is first shown to notice an offence.
"""

import ast
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
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
        (file_length, [*PACKAGE_FILES, *TEST_FILES]),
        (function_length, [*PACKAGE_FILES, *TEST_FILES]),
        (skips_have_reasons, TEST_FILES),
        (machine_independent, text_files()),
        (no_index_hosts, config_files()),
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


@pytest.mark.parametrize(
    ("rule", "offence"),
    [
        (file_length, "\n" * (MAX_FILE_LINES + 1)),
        (function_length, "def f():\n" + "    1\n" * MAX_FUNCTION_LINES),
        (skips_have_reasons, "@pytest.mark.skip\ndef test(): pass"),
        (skips_have_reasons, "pytest.skip()"),
        (skips_have_reasons, "pytest.mark.skipif(True)"),
        (machine_independent, "see /home/me/scene"),
        (no_index_hosts, "--index-url https://mirror"),
        (no_circular_nerfstudio_imports, "from nerfstudio.configs.method_configs import all_methods"),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_each_rule_notices_an_offence(rule, offence):
    assert len(list(rule(offence))) == 1


@pytest.mark.parametrize(
    ("rule", "innocent"),
    [
        (function_length, "def f():\n" + "    1\n" * (MAX_FUNCTION_LINES - 1)),
        (skips_have_reasons, "pytest.skip('no data'); pytest.mark.skipif(True, reason='no data')"),
        (machine_independent, "https://host/work/page ../work/x ~/root/x"),
        (no_circular_nerfstudio_imports, "def f():\n    from nerfstudio.configs.method_configs import x"),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_no_rule_bothers_the_innocent(rule, innocent):
    assert list(rule(innocent)) == []


def lint_imports(folder: Path) -> subprocess.CompletedProcess:
    """Run import-linter with this project's contracts on the package in `folder`."""
    command = [sys.executable, "-c", "from importlinter.cli import lint_imports_command as run; run()"]
    options = ["--no-cache", "--config", str(ROOT / ".importlinter")]
    return subprocess.run([*command, *options], cwd=folder, capture_output=True, text=True, check=False)


def test_imports_keep_to_the_contracts():
    result = lint_imports(ROOT)
    assert result.returncode == 0, result.stdout + result.stderr


OFFENCES = [
    (
        "engine/types.py",
        "import abcd_ns.nerfstudio.model",
        "abcd_ns.engine.types -> abcd_ns.nerfstudio.model",
    ),
    ("engine/types.py", "import abcd_ns.cli.main", "abcd_ns.engine.types -> abcd_ns.cli.main"),
    ("nerfstudio/model.py", "from abcd_ns.cli import main", "abcd_ns.nerfstudio.model -> abcd_ns.cli.main"),
    (
        "engine/render/base.py",
        "import abcd_ns.engine.train",
        "abcd_ns.engine.render.base -> abcd_ns.engine.train",
    ),
    ("engine/types.py", "from nerfstudio.utils import colormaps", "abcd_ns.engine.types -> nerfstudio"),
    ("engine/types.py", "def late():\n    import viser", "abcd_ns.engine.types -> viser"),
    ("engine/types.py", "import rich.console", "abcd_ns.engine.types -> rich"),
    ("engine/types.py", "import tyro", "abcd_ns.engine.types -> tyro"),
    ("peers/exact.py", "import viser", "abcd_ns.peers.exact -> viser"),
    ("run/begin.py", "import abcd_ns.nerfstudio.model", "abcd_ns.run.begin -> abcd_ns.nerfstudio.model"),
    ("engine/types.py", "import gsplat", "abcd_ns.engine.types -> gsplat"),
    (
        "nerfstudio/model.py",
        "from gsplat.strategy import DefaultStrategy",
        "abcd_ns.nerfstudio.model -> gsplat",
    ),
    ("cluster/dispatcher.py", "import ray", "abcd_ns.cluster.dispatcher -> ray"),
    ("engine/types.py", "import abcd_ns.engine.space.tree", ".types -> .space (1 import)"),
]
"""What breaks a contract, and how it is told; the last one is a cycle."""


def test_the_contracts_notice_every_offence(tmp_path):
    skeleton = {"errors.py": "", "cli/main.py": "import abcd_ns.nerfstudio.model", "nerfstudio/model.py": ""}
    skeleton |= dict.fromkeys(
        (
            "progress_bar.py",
            "machine.py",
            "units.py",
            "lab/__init__.py",
            "data/__init__.py",
            "peers/exact.py",
            "formats/ply.py",
        ),
        "",
    )
    skeleton |= {"cluster/connect.py": "import ray", "cluster/ray_workers.py": "import ray"}
    floors = ("kernels", "gaussians", "render", "space", "store", "layers", "train")
    skeleton |= {f"engine/{floor}/__init__.py": "" for floor in floors} | {"engine/transfer.py": ""}
    skeleton |= {"engine/types.py": "", "engine/space/tree.py": "import abcd_ns.engine.types"}
    gsplat = ("engine/train/density/control.py", "engine/render/cuda/backend.py")
    skeleton |= dict.fromkeys(gsplat, "import gsplat") | {"engine/events.py": ""}
    for module, statement, _ in OFFENCES:
        skeleton[module] = f"{skeleton.get(module, '')}\n{statement}"
    for name, source in skeleton.items():
        path = tmp_path / "abcd_ns" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(source)
    for folder in [tmp_path / "abcd_ns", *(p for p in (tmp_path / "abcd_ns").rglob("*") if p.is_dir())]:
        (folder / "__init__.py").touch()

    result = lint_imports(tmp_path)

    assert result.returncode == 1, result.stdout + result.stderr
    assert "Contracts: 0 kept" in result.stdout
    assert [edge for *_, edge in OFFENCES if edge not in result.stdout] == []


def entry_points() -> list[str]:
    """Every "module:name" that installing the package announces."""
    project = PYPROJECT["project"]
    groups = [project["scripts"], *project["entry-points"].values()]
    return [target for group in groups for target in group.values()]


@pytest.mark.parametrize("target", entry_points())
def test_entry_points_exist(target):
    module, name = target.split(":")
    tree = ast.parse((ROOT / (module.replace(".", "/") + ".py")).read_text())
    defined = {node.name for node in tree.body if isinstance(node, (*_FUNCTION, ast.ClassDef))}
    for node in tree.body:
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        defined |= {target.id for target in targets if isinstance(target, ast.Name)}
    assert name in defined


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
