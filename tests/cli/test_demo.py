"""`abcd demo`: the right commands in the right order, and what is said when one of them fails.

Here nerfstudio's commands are calls that leave what the real ones do.
"""

import os
import subprocess
from pathlib import Path

import pytest
import tyro
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion

from abcd_ns.cli import demo as demo_module
from abcd_ns.cli.demo import demo
from abcd_ns.cli.report.command import report
from abcd_ns.errors import UserError
from tests.cli.report.runs import line, log_lines, write_log
from tests.test_documents import no_deed


def run_instead(command: list[str]) -> None:
    """Leave what a command leaves that `abcd demo` looks at."""
    if command[0] == "ns-train":
        config = tyro.cli(AnnotatedBaseConfigUnion, args=command[1:])
        folder = config.output_dir / config.experiment_name / config.method_name / config.timestamp
        (folder / "abcd").mkdir(parents=True)
        (folder / "config.yml").touch()
        end = line("end", 40, 17.0, gaussians=1234, peak_rss_bytes=3 << 30)
        ended = [] if "DISK_IS_FULL" in os.environ else [end]
        write_log(folder / "abcd/log.jsonl", [*log_lines(), *ended])
    else:
        run = Path(command[2]) if command[0] == "abcd" else Path(command[3]).parent
        assert (run / "config.yml").exists()


@pytest.fixture
def calls(monkeypatch) -> list[list[str]]:
    """The commands that were run; one whose name is in the variable BROKEN fails."""
    found = []

    def run(command, stdin, check, stdout=None, stderr=None):
        assert (stdin, check) == (subprocess.DEVNULL, False)
        assert (stdout is None) == (stderr is None) == (command[0] == "ns-train")
        found.append(command)
        if stdout:
            stdout.write(f"output of {command[0]}".encode())
        failed = command[0] == os.environ.get("BROKEN")
        if not failed:
            run_instead(command)
        return subprocess.CompletedProcess(command, 3 if failed else 0)

    monkeypatch.setattr(subprocess, "run", run)
    monkeypatch.setattr(demo_module, "tool", lambda name: name)
    monkeypatch.setattr(demo_module, "SCENE", {"count": 3, "size": (32, 24), "points": 30})
    return found


def test_demo_runs_its_steps_and_says_what_came_of_them(calls, tmp_path, capsys):
    out = tmp_path / "demo"
    assert demo(out=out, seconds=5.0, blocks=3) == 0
    assert [name for name, *_ in calls] == ["ns-train", "ns-export", "abcd"]
    tyro.cli(no_deed(report), args=calls[2][2:])
    config = tyro.cli(AnnotatedBaseConfigUnion, args=calls[0][1:])
    assert (config.pipeline.blocks, config.pipeline.max_seconds) == (3, 5.0)
    assert config.steps_per_eval_all_images > 0  # or the end is not scored
    assert config.data == (out / "scene").resolve()
    printed = capsys.readouterr().out
    assert f"$ ns-train abcd --data {out / 'scene'}" in printed
    figures = ("24.50 dB, SSIM 0.750", "1,234", "3.0 GiB", "0 of 3 blocks")
    for part in (*figures, str(out / "splat.ply"), str(out / "report.html"), "abcd demo --seconds 10"):
        assert part in printed
    assert (out / "logs" / "ns-export.log").read_text() == "output of ns-export"


def test_a_log_that_the_disk_refused_leaves_the_rest_of_the_summary(calls, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("DISK_IS_FULL", "")
    assert demo(out=tmp_path / "demo", seconds=5.0, blocks=3) == 0
    assert [name for name, *_ in calls] == ["ns-train", "ns-export", "abcd"]
    assert "peak RAM               not measured" in capsys.readouterr().out


@pytest.mark.parametrize(("broken", "where"), [("ns-train", "its output above"), ("ns-export", "export.log")])
def test_a_failing_command_ends_the_demo_in_one_line(calls, tmp_path, monkeypatch, broken, where):
    monkeypatch.setenv("BROKEN", broken)
    with pytest.raises(UserError, match=f"{broken} failed with exit code 3; see .*{where}"):
        demo(out=tmp_path / "demo", seconds=1.0)
    assert calls[-1][0] == broken


def test_options_out_of_range_and_a_folder_of_something_else_are_refused(calls, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("")
    with pytest.raises(UserError, match="is not empty and holds no demo"):
        demo(out=tmp_path / "mine")
    assert os.listdir(tmp_path / "mine") == ["thesis.tex"]
    with pytest.raises(UserError, match=r"thesis.tex/demo cannot be written: Not a directory"):
        demo(out=tmp_path / "mine" / "thesis.tex" / "demo")
    for option, value in (("seconds", 0.0), ("seconds", float("nan")), ("blocks", 0)):
        with pytest.raises(UserError, match=f"--{option} is {value}"):
            demo(out=tmp_path / "demo", **{option: value})
    assert calls == []
    assert not (tmp_path / "demo").exists()
