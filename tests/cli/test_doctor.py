"""`abcd doctor`: every ailment is found by what it leaves in the facts, and nothing is built or written."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch.utils import cpp_extension

from abcd_ns.cli import doctor as doctor_module
from abcd_ns.cli.doctor import COMPILER, PACKAGES, TESTED, Facts, diagnose, doctor, find_extension

GIB = 2**30
HEALTHY = Facts(
    abcd_ns="0.1.0; Python 3.11.9",
    versions=dict.fromkeys(PACKAGES, "1.0") | TESTED,
    ray="2.60.0",
    broken={},
    registered=True,
    has_ns_train=True,
    os="Linux",
    ram_bytes=64 * GIB,
    ram_free_bytes=60 * GIB,
    disk_free_bytes=500 * GIB,
    driver="580.1",
    cpu="a CPU",
    cores=8,
    gpu="a GPU, 80.0 GiB, capability 9.0",
    gpus=2,
    torch_cuda="13.0",
    folder="/cache/kernels",
    built=True,
    gsplat="/cache/gsplat_cuda.so",
    build_tools={"nvcc": "13.0", "ninja": "/usr/bin/ninja", COMPILER: "g++"},
    difference=1e-6,
)
NO_GPU = replace(HEALTHY, gpu=None, driver=None)
TORCHVISION = {"torchvision": "operator torchvision::nms does not exist"}


def but(**changes) -> Facts:
    return replace(HEALTHY, **changes)


def with_version(**versions) -> Facts:
    return but(versions=HEALTHY.versions | versions)


def with_tools(tools: dict, **changes) -> Facts:
    return but(gsplat=None, build_tools={**HEALTHY.build_tools, **tools}, **changes)


@pytest.mark.parametrize(
    ("found", "workers"),
    [
        (HEALTHY, "up to 2, one for each GPU: ns-train's --pipeline.workers, by Ray 2.60.0"),
        (but(ray=None), "up to 2, one for each GPU: ns-train's --pipeline.workers, after pip install"),
        (but(gpus=1), "none here: one GPU"),
        (NO_GPU, "up to 8, one for each core"),
        (replace(NO_GPU, cores=1), "none here: one core"),
        (with_version(gsplat="1.4.0+pt24cu124"), "up to 2"),  # a version for one CUDA is that version
    ],
)
def test_a_healthy_machine_has_no_warnings_and_so_many_workers(capsys, monkeypatch, found, workers):
    monkeypatch.setattr(doctor_module, "gather", lambda: found)
    assert doctor() == 0
    shown = capsys.readouterr().out
    assert f"\nworkers         {workers}" in shown
    assert ("a CPU, 1 core\n" in shown) == (found.cores == 1)
    assert {finding.name for finding in diagnose(found)} <= {"no-gpu"}


@pytest.mark.parametrize(
    ("found", "level", "name", "said"),
    [
        (with_version(pycolmap=None), "error", "missing-packages", "pycolmap"),
        (but(broken={"cv2": "libGL.so.1: no"}), "error", "broken-package", "apt-get"),
        (but(broken=TORCHVISION), "error", "broken-package", "do not belong together"),
        (but(broken={"open3d": "libusb"}), "warning", "broken-export", "ns-export"),
        (but(registered=False), "error", "not-registered", "pip install ."),
        (but(has_ns_train=False), "error", "no-ns-train", "nerfstudio"),
        (with_version(gsplat="1.5.3"), "warning", "untested-version", "gsplat==1.4.0"),
        (but(disk_free_bytes=GIB), "warning", "little-disk", "1.0 GiB"),
        (but(ram_free_bytes=GIB), "warning", "little-ram", "1.0 GiB"),
        (NO_GPU, "note", "no-gpu", "CPU"),
        (but(gpu=None, torch_cuda=None), "warning", "torch-without-cuda", "580.1"),
        (but(gpu=None), "warning", "cuda-unavailable", "CUDA_VISIBLE_DEVICES"),
        (with_tools({COMPILER: None}, gpu=None, built=False), "warning", "no-compiler", "g++"),
        (but(gsplat=None), "note", "gsplat-not-built", "MAX_JOBS"),
        (with_tools({"nvcc": None}), "error", "gsplat-cannot-be-built", "nvcc"),
        (with_tools({"ninja": None}), "error", "gsplat-cannot-be-built", "ninja"),
        (with_tools({"nvcc": "12.4"}), "error", "gsplat-cannot-be-built", "12.4"),
        (but(difference=None, failed="is off"), "error", "self-check", "/cache/kernels"),
        (but(lpips_missing="LPIPS needs weights"), "note", "no-lpips", "LPIPS needs weights"),
    ],
)
def test_each_ailment_is_found_with_its_cure(found, level, name, said):
    wanted = [finding for finding in diagnose(found) if finding.name == name]
    assert [finding.level for finding in wanted] == [level]
    assert said in wanted[0].what + wanted[0].fix


def test_the_report_names_no_home(monkeypatch, capsys):
    home = str(Path.home())
    found = but(broken={"cv2": f"no {home}/lib.so"}, folder=f"{home}/.cache/x")
    monkeypatch.setattr(doctor_module, "gather", lambda: found)
    doctor(verbose=True)
    said = capsys.readouterr().out
    assert home + "/" not in said
    assert "~/.cache/x" in said
    assert "~/lib.so" in said


# Looking


def test_this_environment_starts_and_looking_builds_nothing(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(doctor_module, "STARTED", doctor_module.STARTED[:-1])  # open3d takes seconds
    for name in ("ABCD_KERNELS", "TORCH_EXTENSIONS_DIR", "XDG_CACHE_HOME"):
        monkeypatch.setenv(name, str(tmp_path / name))
    found = doctor_module.gather()
    assert (found.broken, found.failed, found.built, found.gsplat) == ({}, None, False, None)
    assert 0 <= found.difference < 2e-3
    assert found.versions["nerfstudio"] is not None
    assert (found.gpu is None) == (not torch.cuda.is_available())
    assert os.listdir(tmp_path) == []


def test_modules_that_do_not_start_are_told_with_their_error(monkeypatch, tmp_path):
    (tmp_path / "a_broken_module.py").write_text("raise RuntimeError('no such operator\\nmore')\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    assert doctor_module._start("json") is None
    assert doctor_module._start("a_broken_module") == "RuntimeError: no such operator"
    assert doctor_module._start("no_module_of_this_name").startswith("ModuleNotFoundError")
    monkeypatch.setattr(doctor_module, "EXPORT", "a_broken_module")  # looked at in a process of its own
    assert doctor_module._start("a_broken_module") == "more"


@pytest.mark.parametrize("cuda", [None, "13.0"])
def test_extensions_are_found_where_torch_builds_them(monkeypatch, tmp_path, cuda):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("TORCH_EXTENSIONS_DIR", raising=False)
    monkeypatch.setattr(torch.version, "cuda", cuda)
    assert find_extension() is None
    assert list(tmp_path.iterdir()) == []
    built = Path(cpp_extension._get_build_directory("gsplat_cuda", verbose=False)) / "gsplat_cuda.so"
    built.touch()
    assert find_extension() == built


def test_it_starts_without_torch():
    """Otherwise it could not say what is wrong with torch."""
    code = (
        "import sys; sys.modules['torch'] = None\n"
        "from abcd_ns.cli import doctor\n"
        "doctor.STARTED = doctor.STARTED[:-1]\n"
        "sys.exit(doctor.doctor())"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert run.returncode == 1, run.stderr
    for said in ("torch does not start", "unknown, as torch does not start", "Training cannot work here yet"):
        assert said in run.stdout
