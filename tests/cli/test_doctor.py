"""`abcd doctor`: every ailment is found by what it leaves in the facts, and nothing is built or written."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import psutil
import pytest
import torch
from torch.utils import cpp_extension

from abcd_ns.cli.doctor import command, hardware, kernels, packages
from abcd_ns.cli.doctor.command import diagnose, doctor
from abcd_ns.cli.doctor.facts import Facts
from abcd_ns.cli.doctor.hardware import Gpu, Hardware
from abcd_ns.cli.doctor.kernels import Kernels, build_folder, find_extension, look_at_kernels
from abcd_ns.cli.doctor.packages import VERSIONS, Packages, look_at_packages
from abcd_ns.cli.doctor.rules import TESTED
from abcd_ns.errors import UserError

GIB = 2**30
HEALTHY = Facts(
    Packages(
        abcd_ns="0.1.0",
        commit=None,
        python="3.11.9",
        versions=dict.fromkeys(VERSIONS, "1.0") | TESTED | {"viser": "1.0.25"},
        ray="2.60.0",
        broken={},
        registered=True,
        has_ns_train=True,
    ),
    Hardware(
        os="Linux",
        cpu="a CPU",
        cores=8,
        ram_bytes=64 * GIB,
        ram_free_bytes=60 * GIB,
        disk_free_bytes=500 * GIB,
        may_write=True,
        gpu=Gpu("a GPU", 80 * GIB, "9.0"),
        gpus=2,
        torch_cuda="13.0",
        driver="580.1",
    ),
    Kernels(
        built=True,
        folder="/cache/kernels",
        compiler="g++",
        gsplat="/cache/gsplat_cuda.so",
        nvcc="13.0",
        ninja=True,
        self_check={"torch on cpu": 1e-6, "gsplat on cuda": 2e-5},
        failed={},
        lpips_missing=None,
    ),
)
NO_GPU = replace(HEALTHY, hardware=replace(HEALTHY.hardware, gpu=None, driver=None))


def with_packages(**changes) -> Facts:
    return replace(HEALTHY, packages=replace(HEALTHY.packages, **changes))


def with_version(**versions) -> Facts:
    return with_packages(versions=HEALTHY.packages.versions | versions)


def with_hardware(**changes) -> Facts:
    return replace(HEALTHY, hardware=replace(HEALTHY.hardware, **changes))


def with_kernels(facts: Facts = HEALTHY, **changes) -> Facts:
    return replace(facts, kernels=replace(facts.kernels, **changes))


@pytest.mark.parametrize(
    ("facts", "said"),
    [
        (HEALTHY, "up to 2, one for each GPU: --pipeline.workers, by Ray 2.60.0"),
        (with_packages(ray=None), "up to 2, one for each GPU: --pipeline.workers, after pip install"),
        (with_hardware(gpus=1), "none here: one GPU"),
        (NO_GPU, "up to 8, one for each core"),
    ],
)
def test_it_says_how_many_workers_there_could_be(capsys, monkeypatch, facts, said):
    monkeypatch.setattr(command, "gather", lambda: facts)
    assert doctor() == 0
    (line,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith("workers"))
    assert said in line


def test_a_healthy_machine_has_no_findings():
    assert diagnose(HEALTHY).findings == ()


@pytest.mark.parametrize(
    ("facts", "level", "name", "said"),
    [
        (with_version(pycolmap=None), "error", "missing-packages", "pycolmap"),
        (with_packages(broken={"cv2": "libGL.so.1: no"}), "error", "broken-package", "apt-get"),
        (
            with_packages(broken={"torchvision": "operator torchvision::nms does not exist"}),
            "error",
            "broken-package",
            "do not belong together",
        ),
        (with_packages(broken={"open3d": "libusb"}), "warning", "broken-export", "ns-export"),
        (with_packages(registered=False), "error", "not-registered", "pip install ."),
        (with_packages(has_ns_train=False), "error", "no-ns-train", "nerfstudio"),
        (with_version(gsplat="1.5.3"), "warning", "untested-version", "gsplat==1.4.0"),
        (with_version(viser="0.2.7"), "note", "viewer-hole", "websocket-host 127.0.0.1"),
        (with_version(viser="1.0.24"), "note", "viewer-hole", "1.0.24"),
        (with_hardware(may_write=False), "error", "read-only-folder", "--output-dir"),
        (with_hardware(disk_free_bytes=GIB), "warning", "little-disk", "1.0 GiB"),
        (with_hardware(ram_free_bytes=GIB), "warning", "little-ram", "1.0 GiB"),
        (NO_GPU, "note", "no-gpu", "CPU"),
        (with_hardware(gpu=None, torch_cuda=None), "warning", "torch-without-cuda", "580.1"),
        (with_hardware(gpu=None), "warning", "cuda-unavailable", "CUDA_VISIBLE_DEVICES"),
        (with_kernels(NO_GPU, built=False), "note", "library-not-compiled", "15 seconds"),
        (with_kernels(NO_GPU, built=False, compiler=None), "warning", "no-compiler", "g++"),
        (with_kernels(gsplat=None), "note", "gsplat-not-built", "MAX_JOBS"),
        (with_kernels(gsplat=None, nvcc=None), "error", "gsplat-cannot-be-built", "nvcc"),
        (with_kernels(gsplat=None, ninja=False), "error", "gsplat-cannot-be-built", "ninja"),
        (with_kernels(gsplat=None, nvcc="12.4"), "error", "gsplat-cannot-be-built", "12.4"),
        (with_kernels(failed={"gsplat on cuda": "is off"}), "error", "self-check", "rasterizer torch"),
        (with_kernels(failed={"torch on cpu": "is off"}), "error", "self-check", "/cache/kernels"),
        (with_kernels(lpips_missing="LPIPS needs weights"), "note", "no-lpips", "LPIPS needs weights"),
    ],
)
def test_each_ailment_is_found_with_its_cure(facts, level, name, said):
    wanted = [finding for finding in diagnose(facts).findings if finding.name == name]
    assert [finding.level for finding in wanted] == [level]
    assert said in wanted[0].what + wanted[0].fix


@pytest.mark.parametrize("versions", [{"viser": "1.1.0"}, {"viser": "2"}, {"gsplat": "1.4.0+pt24cu124"}])
def test_sound_versions_are_left_alone(versions):
    assert diagnose(with_version(**versions)).findings == ()


def test_where_torch_does_not_start_the_rest_is_still_said(capsys, monkeypatch):
    broken = replace(with_packages(broken={"torch": "ImportError: libcudart"}), hardware=None, kernels=None)
    monkeypatch.setattr(command, "gather", lambda: broken)
    assert doctor() == 1
    printed = capsys.readouterr().out
    assert "torch does not start: ImportError: libcudart" in printed
    assert "unknown, as torch does not start" in printed
    assert "Training cannot work here yet" in printed


def test_where_all_is_well_the_screen_is_short_and_notes_wait_to_be_asked_for(capsys, monkeypatch):
    facts = with_kernels(with_version(viser="0.2.7"), lpips_missing="LPIPS needs weights")
    monkeypatch.setattr(command, "gather", lambda: facts)
    assert doctor() == 0
    short = capsys.readouterr().out
    assert len(short.splitlines()) <= 12
    assert "viewer-hole" not in short
    assert "2 notes: abcd doctor --verbose" in short
    doctor(verbose=True)
    full = capsys.readouterr().out
    for said in ("viewer-hole", "no-lpips", "pycolmap", "13.0"):
        assert said in full


def test_the_report_names_no_home(tmp_path, monkeypatch, capsys):
    home = str(Path.home())
    facts = with_kernels(with_packages(broken={"cv2": f"no {home}/lib.so"}), folder=f"{home}/.cache/x")
    monkeypatch.setattr(command, "gather", lambda: facts)
    doctor(json=tmp_path / "report.json", verbose=True)
    text = (tmp_path / "report.json").read_text()
    for said in (text, capsys.readouterr().out):
        assert home + "/" not in said
        assert "~/.cache/x" in said
        assert "~/lib.so" in said
    assert json.loads(text)["facts"]["kernels"]["nvcc"] == "13.0"


def test_a_report_that_cannot_be_written_is_refused_first(tmp_path):
    with pytest.raises(UserError, match="does not exist"):
        doctor(json=tmp_path / "no" / "report.json")


# Looking


def test_this_environment_starts(monkeypatch):
    monkeypatch.setattr(packages, "_start_apart", lambda _: None)
    calls = []
    found = look_at_packages(lambda: calls.append(1))
    assert found.broken == {}
    assert found.versions["nerfstudio"] is not None
    assert len(calls) == len(packages.STARTED) + 1


def test_modules_that_do_not_start_are_told_with_their_error(monkeypatch, tmp_path):
    (tmp_path / "a_broken_module.py").write_text("raise RuntimeError('no such operator\\nmore')\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(packages, "STARTED", ("json", "a_broken_module", "no_module_of_this_name"))
    monkeypatch.setattr(packages, "EXPORT", "a_broken_module")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    broken = look_at_packages(lambda: None).broken
    assert broken["a_broken_module"] == "more"  # the export's, looked at in a process of its own
    assert broken["no_module_of_this_name"].startswith("ModuleNotFoundError")
    assert "json" not in broken


def test_hardware_is_what_others_see(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    found = hardware.look_at_hardware()
    assert found.ram_bytes == psutil.virtual_memory().total
    assert 0 < found.ram_free_bytes <= found.ram_bytes
    assert found.may_write
    assert (found.gpu is None) == (not torch.cuda.is_available())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("cuda", "hip"), [(None, None), ("13.0", None), (None, "6.2.1")], ids=["cpu", "cuda", "rocm"]
)
def test_extensions_are_looked_for_where_torch_builds_them(monkeypatch, tmp_path, cuda, hip):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("TORCH_EXTENSIONS_DIR", raising=False)
    monkeypatch.setattr(torch.version, "cuda", cuda)
    monkeypatch.setattr(torch.version, "hip", hip)
    folder = build_folder()
    assert not folder.exists()
    assert str(folder) == cpp_extension._get_build_directory("gsplat_cuda", verbose=False)


def test_an_extension_that_was_built_is_found(monkeypatch, tmp_path):
    monkeypatch.setenv("TORCH_EXTENSIONS_DIR", str(tmp_path))
    assert find_extension() is None
    (tmp_path / "gsplat_cuda").mkdir()
    (tmp_path / "gsplat_cuda" / "gsplat_cuda.so").touch()
    assert find_extension() == tmp_path / "gsplat_cuda" / "gsplat_cuda.so"


def test_looking_at_kernels_builds_nothing(monkeypatch, tmp_path):
    monkeypatch.setenv("ABCD_KERNELS", str(tmp_path / "kernels"))
    monkeypatch.setenv("TORCH_EXTENSIONS_DIR", str(tmp_path / "extensions"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    found = look_at_kernels(on_gpu=False)
    assert not found.built
    assert found.gsplat is None
    assert found.failed == {}
    assert 0 <= found.self_check["torch on cpu"] < 2e-3
    assert os.listdir(tmp_path) == []


def test_an_extension_that_does_not_load_is_a_finding(monkeypatch, tmp_path):
    """As one that was built for another torch."""
    monkeypatch.delitem(sys.modules, "gsplat.cuda._backend", raising=False)
    path = tmp_path / "gsplat_cuda.so"
    path.write_bytes(b"no library")
    _, failed = kernels._self_checks(False, path)
    assert str(path) in failed["gsplat on cuda"]
    assert "gsplat.cuda._backend" not in sys.modules


def test_it_starts_without_torch():
    """Otherwise it could not say what is wrong with torch."""
    code = (
        "import sys; sys.modules['torch'] = None\n"
        "from abcd_ns.cli.doctor import command, packages\n"
        "packages._start_apart = lambda _: None\n"
        "sys.exit(command.doctor())"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert run.returncode == 1, run.stderr
    assert "torch does not start" in run.stdout
