"""What installing brings: a wheel with all files that the code opens, described by valid metadata."""

import email
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import yaml

import abcd_ns

ROOT = Path(__file__).resolve().parent.parent
BUILD = "from setuptools import build_meta; print(build_meta.build_wheel('out'))"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> zipfile.ZipFile:
    """Built in a copy, since setuptools leaves its own folders behind."""
    copy = tmp_path_factory.mktemp("copy")
    for name in ("pyproject.toml", "README.md", "LICENSE", "MANIFEST.in"):
        shutil.copy(ROOT / name, copy)
    for name in ("abcd_ns", "configs"):
        shutil.copytree(ROOT / name, copy / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    run = subprocess.run([sys.executable, "-c", BUILD], cwd=copy, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    return zipfile.ZipFile(copy / "out" / run.stdout.split()[-1])


def test_the_wheel_holds_every_file_of_the_package_and_no_other(wheel):
    """Whatever is not code is opened by code: options, the report's page, the mark that types are there."""
    there = {path.relative_to(ROOT).as_posix() for path in (ROOT / "abcd_ns").rglob("*") if path.is_file()}
    there |= {f"abcd_ns/configs/{path.name}" for path in (ROOT / "configs").iterdir()}
    there = {name for name in there if "__pycache__" not in name}
    assert {"abcd_ns/py.typed", "abcd_ns/configs/small-gpu.toml", "abcd_ns/cli/report/page.html"} <= there
    assert {name for name in wheel.namelist() if ".dist-info/" not in name} == there


def test_the_metadata_say_whose_it_is_and_what_it_needs(wheel):
    (name,) = (name for name in wheel.namelist() if name.endswith("/METADATA"))
    metadata = email.message_from_bytes(wheel.read(name))
    assert metadata["Author"] == "The abcd_ns authors"
    assert metadata["License-Expression"] == "Apache-2.0"
    assert metadata["Description-Content-Type"] == "text/markdown"
    required = {re.match(r"[\w-]+", line).group() for line in metadata.get_all("Requires-Dist")}
    assert {"nerfstudio", "gsplat", "torch"} <= required
    lines = (line for line in metadata.get_all("Requires-Dist") if "extra ==" not in line)
    pins = [line.partition(";")[0] for line in lines]
    # gsplat's internals are called, and splines 0.3.0, which nerfstudio 1.1.5 pins, fails with numpy 2.2.
    assert [pin for pin in pins if "==" in pin or "<" in pin] == ["gsplat==1.4.*", "numpy<2.2"]
    assert "pycolmap>=3.13" in pins  # `abcd poses` calls what older ones lack


def test_the_citation_is_of_this_version():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert str(citation["version"]) == abcd_ns.__version__
    assert citation["preferred-citation"]["doi"] in (ROOT / "README.md").read_text()


@pytest.mark.parametrize("path", sorted((ROOT / ".github").rglob("*.yml")), ids=lambda path: path.name)
def test_what_the_forge_reads_runs_files_that_are_there(path):
    text = path.read_text()
    assert yaml.safe_load(text)
    for script in re.findall(r"scripts/[\w.]+", text):
        assert (ROOT / script).stat().st_mode & 0o100, script
    for target in re.findall(r"\bmake ([a-z]+)", text):
        assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text(), re.MULTILINE), target
