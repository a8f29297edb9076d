"""What nerfstudio loads for each of its commands: where something is missing, only our own methods are."""

import re
import sys
from contextlib import redirect_stdout
from importlib.metadata import packages_distributions
from io import StringIO

import nerfstudio.configs.method_configs  # noqa: F401 - what is stock is there
import pytest
from nerfstudio.plugins.registry import discover_methods
from nerfstudio.plugins.registry_dataparser import discover_dataparsers

from tests.nerfstudio.forks import forget, in_a_fork
from tests.test_house_rules import PACKAGE_FILES, PYPROJECT

NEEDED = ("viser", "cv2", "fcntl")
NOT_NEEDED = ("trimesh", "pycolmap", "matplotlib", "jinja2", "markupsafe", "ray")


def discovered(*missing: str) -> tuple[object, str, bool]:
    """Our method, its words and whether our reader is there, as nerfstudio finds them without modules."""
    forget("abcd_ns")
    before = {name: found for name, found in sys.modules.items() if name.split(".")[0] in missing}
    sys.modules.update(dict.fromkeys([*missing, *before]))  # None: importing it fails
    methods, words = discover_methods()
    parsers, _ = discover_dataparsers()
    for module in missing:
        del sys.modules[module]
    sys.modules.update(before)
    return methods["abcd"], words["abcd"], "abcd-data" in parsers


def discover_all() -> tuple[dict, str]:
    """What nerfstudio finds while something is missing, by what that is; and what is said on the terminal."""
    found = {name: discovered(name) for name in NEEDED}
    found["others"] = discovered(*NOT_NEEDED)
    with pytest.raises(SystemExit) as end, redirect_stdout(StringIO()) as said:
        found["fcntl"][0].print_to_terminal()
    kinds = {name: (type(config).__name__, *rest) for name, (config, *rest) in found.items()}
    return {**kinds, "code": end.value.code}, said.getvalue()


@pytest.fixture(scope="module")
def without() -> tuple[dict, str]:
    return in_a_fork(discover_all)


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


def test_what_training_does_not_need_may_be_missing(without):
    kind, words, has_parser = without[0]["others"]
    assert kind == "AbcdTrainerConfig", words
    assert has_parser


def normal(distribution: str) -> str:
    return distribution.lower().replace("_", "-")


def test_what_is_imported_is_declared():
    lines = re.compile(r"^\s*(?:from|import) (\w+)", re.MULTILINE)
    names = {name for path in PACKAGE_FILES for name in lines.findall(path.read_text())}
    installed = packages_distributions()
    # torch brings Triton where it runs; elsewhere it is not missed.
    names &= set(installed) - {"abcd_ns", "triton"} - set(sys.stdlib_module_names)
    assert len(names) > 15
    project = PYPROJECT["project"]
    extras = [names for extra, names in project["optional-dependencies"].items() if extra != "dev"]
    wanted = [*project["dependencies"], *(name for names in extras for name in names)]
    declared = {normal(re.match(r"[\w.-]+", requirement).group()) for requirement in wanted}
    assert {name for name in names if not declared & set(map(normal, installed[name]))} == set()
