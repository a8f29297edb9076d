"""`abcd demo`: the right commands in the right order, and what is said when one of them fails.

Here nerfstudio's commands are scripts that leave what the real ones do.
"""

import json
import os
import stat
import sys
from pathlib import Path

import pytest
import tyro
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion

from abcd_ns.cli import demo as demo_module
from abcd_ns.cli.demo import demo
from abcd_ns.cli.report.command import report
from abcd_ns.errors import UserError
from tests.cli.report.runs import line, log_lines
from tests.test_documents import no_deed

STAND_IN = """#!{python}
import json, os, pathlib, sys
name, words = pathlib.Path(sys.argv[0]).name, sys.argv[1:]
here = pathlib.Path(sys.argv[0]).parent
with open(here / "calls.jsonl", "a") as file:
    file.write(json.dumps([name, *words]) + "\\n")
print("output of", name)
if name in os.environ.get("BROKEN", "").split():
    sys.exit(3)

def given(flag):
    return pathlib.Path(words[words.index(flag) + 1])

if name == "ns-train":
    run = given("--output-dir") / given("--experiment-name") / words[0] / given("--timestamp")
    (run / "abcd").mkdir(parents=True)
    (run / "config.yml").write_text("")
    (run / "abcd" / "log.jsonl").write_text((here / "log.jsonl").read_text())
elif name == "ns-export":
    assert given("--load-config").is_file()
elif words[0] == "report":
    assert (pathlib.Path(words[1]) / "config.yml").is_file()
    given("--out").write_text("a page")
"""


class StandIns:
    """nerfstudio's commands beside a Python of their own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir()
        for name in ("ns-train", "ns-export", "abcd"):
            path = folder / name
            path.write_text(STAND_IN.format(python=sys.executable))
            path.chmod(path.stat().st_mode | stat.S_IXUSR)
        end = line("end", 40, 17.0, gaussians=1234, peak_rss_bytes=3 << 30)
        (folder / "log.jsonl").write_text("\n".join([*log_lines(), end, ""]))

    def calls(self) -> list[list[str]]:
        path = self.folder / "calls.jsonl"
        return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


@pytest.fixture
def commands(tmp_path, monkeypatch) -> StandIns:
    stand_ins = StandIns(tmp_path / "bin")
    monkeypatch.setattr(demo_module, "tool", lambda name: str(stand_ins.folder / name))
    monkeypatch.setattr(demo_module, "SCENE", {"count": 3, "size": (32, 24), "points": 30})
    return stand_ins


def test_demo_runs_its_steps_and_says_what_came_of_them(commands, tmp_path, capfd):
    out = tmp_path / "demo"
    assert demo(out=out, seconds=5.0, blocks=3) == 0
    calls = commands.calls()
    assert [name for name, *_ in calls] == ["ns-train", "ns-export", "abcd"]
    tyro.cli(no_deed(report), args=calls[2][2:])
    config = tyro.cli(AnnotatedBaseConfigUnion, args=calls[0][1:])
    assert (config.pipeline.blocks, config.pipeline.max_seconds) == (3, 5.0)
    assert config.steps_per_eval_all_images > 0  # or the end is not scored
    assert config.data == (out / "scene").resolve()
    printed = capfd.readouterr().out
    assert f"$ ns-train abcd --data {out / 'scene'}" in printed
    figures = ("24.50 dB, SSIM 0.750", "1,234", "3.0 GiB", "0 of 3 blocks")
    for part in (*figures, str(out / "splat.ply"), str(out / "report.html"), "abcd demo --seconds 10"):
        assert part in printed
    assert "output of ns-train" in printed
    assert "output of ns-export" not in printed
    assert "output of ns-export" in (out / "logs" / "ns-export.log").read_text()


@pytest.mark.parametrize(("broken", "where"), [("ns-train", "its output above"), ("ns-export", "export.log")])
def test_a_failing_command_ends_the_demo_in_one_line(commands, tmp_path, monkeypatch, broken, where):
    monkeypatch.setenv("BROKEN", broken)
    with pytest.raises(UserError, match=f"{broken} failed with exit code 3; see .*{where}"):
        demo(out=tmp_path / "demo", seconds=1.0)
    assert commands.calls()[-1][0] == broken


def test_options_out_of_range_and_a_folder_of_something_else_are_refused(commands, tmp_path):
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
    assert commands.calls() == []
    assert not (tmp_path / "demo").exists()
