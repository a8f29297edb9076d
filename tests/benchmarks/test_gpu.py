"""`python -m benchmarks.gpu` as far as it goes without a GPU: bounds, what is kept of a part, charts."""

import sys
import time
from pathlib import Path

import pytest
import torch
from rich.console import Console

from abcd_ns.errors import UserError
from abcd_ns.lab.results.records import encode, read_json, write_json
from abcd_ns.lab.results.results import Arm
from benchmarks.gpu.__main__ import Args, main, run_bounded, run_part, show
from tests.lab.compare.records import made_up, made_up_run
from tests.reference.colmap_scene import write_scene

GIB = 2**30
WHOLE = {
    "part": "build",
    "dry_run": True,
    "error": None,
    "seconds": 1.0,
    "found": {"hardware": {"gpu": "made up"}},
}
PARTIAL = """
import json, pathlib, sys, time
task = json.loads(pathlib.Path(sys.argv[1]).read_text())
record = {"part": task["part"], "dry_run": True, "error": "unfinished", "found": {"runs": [1]}}
pathlib.Path(task["out"], task["part"] + ".json").write_text(json.dumps(record))
"""


def is_alive(pid: int) -> bool:
    status = Path(f"/proc/{pid}/stat")
    return status.exists() and status.read_text().split()[2] != "Z"


def worker(folder: Path, ends: str) -> tuple[str, str]:
    """A command that finds something, writes it, and then does `ends`."""
    (folder / "worker.py").write_text(PARTIAL + ends)
    return sys.executable, str(folder / "worker.py")


def test_what_passes_its_time_ends_with_all_that_it_started(tmp_path):
    note = tmp_path / "pid"
    command = ["sh", "-c", f"sleep 600 & echo $! > {note}.new; mv {note}.new {note}; wait"]
    assert run_bounded(command, 1.0, tmp_path / "log") == "killed after 1 s, the time it had"
    pid = int(note.read_text())
    for _ in range(100):
        if not is_alive(pid):
            break
        time.sleep(0.1)
    assert not is_alive(pid)


def test_why_a_command_failed_is_the_last_line_of_its_log(tmp_path):
    assert run_bounded(["sh", "-c", "echo no card; exit 3"], 60, tmp_path / "log") == "no card"
    assert run_bounded(["sh", "-c", "exit 3"], 60, tmp_path / "log") == "exit code 3"
    assert run_bounded(["true"], 60, tmp_path / "log") is None


@pytest.mark.parametrize(
    ("ends", "seconds", "error"),
    [
        ("time.sleep(600)", 3.0, "killed after 3 s, the time it had"),
        ("sys.exit('it broke')", 60.0, "it broke"),
        ("", 60.0, None),
    ],
)
def test_what_a_part_had_found_is_kept_however_it_ends(tmp_path, ends, seconds, error):
    record = run_part("compare", Args(dry_run=True), tmp_path, seconds, worker(tmp_path, ends))
    assert (record["error"], record["found"]) == (error, {"runs": [1]})
    assert read_json(tmp_path / "compare.json") == record


def test_a_part_that_is_there_is_not_run_again_unless_it_failed(tmp_path, monkeypatch, capsys):
    ran = []

    def note(part, _, out, seconds):
        ran.append((part, round(seconds)))
        write_json(out / f"{part}.json", WHOLE | {"part": part, "found": {}})
        return WHOLE

    monkeypatch.setattr("benchmarks.gpu.__main__.run_part", note)
    args = {"out": tmp_path, "dry_run": True, "minutes": 11}
    write_json(tmp_path / "build.json", WHOLE | {"error": "killed"})
    assert main(Args(parts=("extent", "build"), **args)) == 0
    assert ran == [("build", 240), ("extent", 660)]  # 4 and 7 shares; what one leaves goes to the next
    assert main(Args(parts=("build",), **args)) == 0
    assert len(ran) == 2
    assert "is there; --again" in capsys.readouterr().out
    assert main(Args(parts=("build",), again=True, **args)) == 0
    assert len(ran) == 3


@pytest.mark.parametrize("dry", [True, False])
def test_records_of_dry_and_real_runs_do_not_mix(tmp_path, monkeypatch, dry):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    ran = []

    def note(part, args, out, _):
        ran.append(part)
        record = WHOLE | {"part": part, "dry_run": args.dry_run, "found": {}}
        write_json(out / f"{part}.json", record)
        return record

    monkeypatch.setattr("benchmarks.gpu.__main__.run_part", note)
    path = tmp_path / "build.json"
    write_json(path, WHOLE | {"dry_run": not dry})
    for part in ("build", "extent"):
        with pytest.raises(
            UserError, match=r"holds records of (dry|real) runs \(build\); name another folder"
        ):
            main(Args(out=tmp_path, parts=(part,), dry_run=dry))
    assert not ran
    assert main(Args(out=tmp_path, parts=("build",), dry_run=dry, again=True)) == 0
    assert (ran, read_json(path)["dry_run"]) == (["build"], dry)
    assert main(Args(out=tmp_path, parts=("build", "extent"), dry_run=dry)) == 0
    assert ran == ["build", "extent"]


def test_without_a_cuda_device_it_says_so(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert main(Args(out=tmp_path / "out")) == 2
    assert "There is no CUDA device" in capsys.readouterr().out
    assert not (tmp_path / "out").exists()


def test_a_comparison_without_a_scene_is_refused(tmp_path):
    with pytest.raises(UserError, match="--data"):
        main(Args(out=tmp_path / "out", dry_run=True))


def test_every_record_is_shown(tmp_path, capsys):
    memory = {"peak_device_bytes": 2 * GIB, "peak_reserved_bytes": 3 * GIB, "peak_device_note": None}
    variants = {"splatfacto": "default", "abcd-monolithic": "default"}
    arms = [*variants.items(), ("abcd", "blocks=1"), ("abcd", "blocks=8")]
    arms = [
        Arm(method, variant, None, (made_up_run(method, psnr=20.0 + k, **memory),))
        for k, (method, variant) in enumerate(arms)
    ]
    found = {"results": encode(made_up("GPU comparison", *arms))}
    show([WHOLE, WHOLE | {"part": "compare", "found": found}], tmp_path, Console())
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"compare-speed_accuracy.png", "compare-memory.png"}
    assert "splatfacto" in capsys.readouterr().out


@pytest.mark.cli
def test_a_dry_run_goes_through(tmp_path, capsys):
    assert main(Args(out=tmp_path, parts=("build",), dry_run=True)) == 0
    checks = read_json(tmp_path / "build.json")["found"]
    assert checks["self_check"] < 1e-3
    assert checks["self_check_2dgs"] < 1e-3
    assert "build" in capsys.readouterr().out


@pytest.mark.slow
def test_all_parts_of_a_dry_run_go_through(tmp_path, capsys):
    out = tmp_path / "out"
    assert main(Args(data=write_scene(tmp_path / "scene"), out=out, dry_run=True)) == 0
    for part in ("compare", "compare-steps"):
        found = read_json(out / f"{part}.json")["found"]["results"]
        assert [(arm["method"], arm["variant"]) for arm in found["arms"]] == [("abcd", "blocks=2")]
        assert found["left_out"][0]["method"] == "splatfacto"
        assert not list((out / "work" / part).rglob("nerfstudio_models"))
    assert read_json(out / "visit.json")["found"]["by_blocks"][0]["profile"]
    assert len(read_json(out / "extent.json")["found"]["results"]["arms"]) == 2
    assert "a dry run: these numbers mean nothing" in capsys.readouterr().out
