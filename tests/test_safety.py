"""What our code never does with files from elsewhere, as far as its text tells."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / "abcd_ns"
FILES = sorted(PACKAGE.rglob("*.py"))
RUNS_CODE = ("pickle", "cPickle", "dill", "cloudpickle", "joblib", "marshal", "shelve")
"""Modules whose files run code when they are read."""
ASKS_OUT = ("requests", "urllib.request", "http.client", "ftplib", "smtplib", "huggingface_hub", "gdown")


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


def test_no_file_can_run_code_and_nothing_asks_a_network():
    assert FILES
    assert [f"{path.name}:{found}" for path in FILES for found in unsafe(path.read_text())] == []


@pytest.mark.parametrize(
    "offence",
    [
        "import pickle",
        "from pickle import loads",
        "def f():\n    import joblib",
        "from urllib import request",
        "import requests",
        "torch.load(path)",
        "torch.load(path, weights_only=False)",
        "np.load(path, allow_pickle=True)",
        "yaml.load(text, Loader=yaml.Loader)",
        "eval(text)",
        "subprocess.run(command, shell=True)",
    ],
)
def test_the_rule_notices_an_offence(offence):
    assert len(list(unsafe(offence))) == 1


@pytest.mark.parametrize(
    "innocent",
    [
        "torch.load(path, weights_only=True)",
        "np.load(path)",
        "pipeline.eval()",
        "from urllib.parse import quote",
    ],
)
def test_the_rule_does_not_bother_the_innocent(innocent):
    assert list(unsafe(innocent)) == []
