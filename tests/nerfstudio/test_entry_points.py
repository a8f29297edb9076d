"""What nerfstudio loads for each of its commands: where something is missing, only our own methods are."""

import json
import re
import subprocess
import sys
from importlib.metadata import packages_distributions

import pytest

from tests.test_house_rules import PACKAGE_FILES, PYPROJECT, ROOT

NEEDED = ("viser", "cv2", "fcntl", "safetensors", "pytorch_msssim")
NOT_NEEDED = ("embreex", "trimesh", "pycolmap", "matplotlib", "jinja2", "markupsafe", "ray")
SCRIPT = """
import json, sys
import nerfstudio.configs.method_configs  # what is stock is there
from nerfstudio.plugins.registry import discover_methods
from nerfstudio.plugins.registry_dataparser import discover_dataparsers

def belongs(module, names):
    return module.split(".")[0] in names

def discovered(*missing):
    for module in [m for m in sys.modules if belongs(m, {"abcd_ns"})]:
        del sys.modules[module]
    before = {m: found for m, found in sys.modules.items() if belongs(m, missing)}
    sys.modules.update(dict.fromkeys([*missing, *before]))  # None: importing it fails
    methods, words = discover_methods()
    parsers, _ = discover_dataparsers()
    for module in missing:
        del sys.modules[module]
    sys.modules.update(before)
    return methods["abcd"], words["abcd"], "abcd-data" in parsers

needed, not_needed = json.loads(sys.argv[1])
found = {name: discovered(name) for name in needed}
found["others"] = discovered(*not_needed)
try:
    found["fcntl"][0].print_to_terminal()
except SystemExit as end:
    code = end.code
kinds = {name: (type(config).__name__, *rest) for name, (config, *rest) in found.items()}
print(json.dumps({**kinds, "code": code}))
"""


@pytest.fixture(scope="module")
def without() -> tuple[dict, str]:
    """What nerfstudio finds while something is missing, by what that is; and what is said on the terminal."""
    command = [sys.executable, "-W", "ignore", "-c", SCRIPT, json.dumps([NEEDED, NOT_NEEDED])]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300, check=False)
    assert ended.returncode == 0, ended.stderr[-3000:]
    *said, last = ended.stdout.splitlines()
    return json.loads(last), "\n".join(said)


@pytest.mark.cli
def test_what_training_needs_is_named_when_it_is_missing(without):
    found, said = without
    for name in NEEDED:
        kind, words, has_parser = found[name]
        assert kind == "UnavailableConfig", name
        assert words.startswith("[cannot start here]")
        assert name in words
        assert has_parser
    assert found["code"] == 2
    assert "fcntl" in said
    assert "it needs Linux or macOS" in said


@pytest.mark.cli
def test_what_training_does_not_need_may_be_missing(without):
    kind, words, has_parser = without[0]["others"]
    assert kind == "AbcdTrainerConfig", words
    assert has_parser


def test_synthetic_scenes_say_what_they_need(monkeypatch):
    for module in [name for name in sys.modules if name.startswith("abcd_ns.lab.synth")]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, "embreex.mesh_construction", None)
    from abcd_ns.errors import UserError

    with pytest.raises(UserError, match="pip install embreex"):
        __import__("abcd_ns.lab.synth.world")


def normal(distribution: str) -> str:
    return distribution.lower().replace("_", "-")


def test_what_is_imported_is_declared():
    lines = re.compile(r"^\s*(?:from|import) (\w+)", re.MULTILINE)
    names = {name for path in PACKAGE_FILES for name in lines.findall(path.read_text())}
    installed = packages_distributions()
    names &= set(installed) - {"abcd_ns"} - set(sys.stdlib_module_names)
    assert len(names) > 15
    project = PYPROJECT["project"]
    extras = [names for extra, names in project["optional-dependencies"].items() if extra != "dev"]
    wanted = [*project["dependencies"], *(name for names in extras for name in names)]
    declared = {normal(re.match(r"[\w.-]+", requirement).group()) for requirement in wanted}
    assert {name for name in names if not declared & set(map(normal, installed[name]))} == set()


def test_development_installs_what_tests_need():
    extras = PYPROJECT["project"]["optional-dependencies"]
    assert set(extras["demo"]) <= set(extras["dev"])
