"""`abcd demo`: the right commands in the right order, and what is said when one of them fails.

Here nerfstudio's commands are scripts that leave what the real ones do.
"""

import json
import os
import stat
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from abcd_ns.cli import demo as demo_module
from abcd_ns.cli.demo import demo
from abcd_ns.errors import UserError

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
    run.mkdir(parents=True)
    (run / "config.yml").write_text("")
elif name == "ns-eval":
    from PIL import Image
    assert given("--load-config").is_file()
    folder = given("--render-output-path")
    folder.mkdir(parents=True, exist_ok=True)
    for row in range(5):
        pair = Image.new("RGB", (64, 24), (200, 100, 50))
        pair.paste((100 + 20 * row, 100, 50), (32, 0, 64, 24))
        pair.save(folder / f"eval_img_{{row:04d}}.png")
    given("--output-path").write_text(json.dumps({{"results": {{"psnr": 21.5, "ssim": 0.75}}}}))
elif name == "ns-export":
    header = b"ply\\nformat binary_little_endian 1.0\\nelement vertex 1234\\nproperty float x\\nend_header\\n"
    (given("--output-dir") / given("--output-filename")).write_bytes(header)
elif name == "abcd-synth":
    pathlib.Path(words[0]).mkdir(exist_ok=True)
elif name == "abcd-report":
    assert (pathlib.Path(words[0]) / "config.yml").is_file()
    given("--out").write_text("a page")
"""


class StandIns:
    """nerfstudio's commands beside a Python of their own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir()
        for name in ("ns-train", "ns-eval", "ns-export", "abcd-synth", "abcd-report"):
            path = folder / name
            path.write_text(STAND_IN.format(python=sys.executable))
            path.chmod(path.stat().st_mode | stat.S_IXUSR)

    def calls(self) -> list[list[str]]:
        path = self.folder / "calls.jsonl"
        return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


@pytest.fixture
def commands(tmp_path, monkeypatch) -> StandIns:
    stand_ins = StandIns(tmp_path / "bin")
    monkeypatch.setattr(demo_module, "_tool", lambda name: str(stand_ins.folder / name))
    monkeypatch.setattr(demo_module, "_abcd", lambda command: [str(stand_ins.folder / f"abcd-{command}")])
    small = {"courts": 1, "views_per_court": 2, "width": 32, "height": 24, "points_per_court": 50}
    monkeypatch.setattr(demo_module, "SCENE", small)
    monkeypatch.setenv("COLUMNS", "200")
    return stand_ins


def test_demo_runs_its_steps_and_says_what_came_of_them(commands, tmp_path, capfd, monkeypatch):
    """Here the scene is a real one."""
    out, stand_in = tmp_path / "demo", demo_module._abcd
    real = [sys.executable, "-m", "abcd_ns.cli.main", "synth"]
    monkeypatch.setattr(demo_module, "_abcd", lambda name: real if name == "synth" else stand_in(name))

    assert demo(out=out, seconds=5.0, blocks=3) == 0

    assert (out / "scene" / "sparse" / "0").is_dir()
    assert [name for name, *_ in commands.calls()] == ["ns-train", "ns-eval", "ns-export", "abcd-report"]
    assert (out / "report.html").read_text() == "a page"
    train = commands.calls()[0]
    assert train[1:4] == ["abcd", "--data", str((out / "scene").resolve())]
    for flag, value in (
        ("--pipeline.blocks", "3"),
        ("--pipeline.max-seconds", "5"),
        ("--vis", "tensorboard"),
        ("--viewer.quit-on-train-completion", "True"),
    ):
        assert train[train.index(flag) + 1] == value
    assert commands.calls()[2][1] == "gaussian-splat"
    printed = capfd.readouterr().out
    assert f"$ abcd synth {out / 'scene'} --courts 1" in printed
    files = (str(out / "splat.ply"), str(out / "report.html"), str(out / "court.png"))
    for part in ("21.50 dB", "0.750", "1,234", "GiB", *files, "ns-viewer --load-config"):
        assert part in printed
    assert "output of ns-train" in printed
    assert "output of ns-eval" not in printed
    assert "output of ns-eval" in (out / "logs" / "ns-eval.log").read_text()
    for colour in ((200, 100, 50), (140, 100, 50)):  # the third of five renderings, by how far they are off
        assert count_pixels(out / "court.png", colour) > 10_000


def count_pixels(path: Path, colour: tuple[int, int, int]) -> int:
    with Image.open(path) as image:
        return int((np.asarray(image.convert("RGB")) == colour).all(axis=2).sum())


@pytest.mark.parametrize(("broken", "where"), [("ns-train", "its output above"), ("ns-eval", "ns-eval.log")])
def test_a_failing_command_ends_the_demo_in_one_line(commands, tmp_path, monkeypatch, capfd, broken, where):
    monkeypatch.setenv("BROKEN", broken)

    assert demo(out=tmp_path / "demo", seconds=1.0) == 1

    last = capfd.readouterr().out.strip().splitlines()[-1]
    assert last.startswith(f"error: {broken.removeprefix('abcd-')} failed with exit code 3; see ")
    assert where in last
    assert commands.calls()[-1][0] == broken


@pytest.mark.usefixtures("commands")
def test_a_second_demo_trains_anew_on_the_same_scene(tmp_path, monkeypatch):
    stamps = iter(("first", "second"))
    monkeypatch.setattr(demo_module.time, "strftime", lambda _: next(stamps))
    out = tmp_path / "demo"
    assert demo(out=out, seconds=1.0) == demo(out=out, seconds=1.0) == 0
    assert sorted(path.name for path in (out / "training" / "demo" / "abcd").iterdir()) == ["first", "second"]


def test_a_folder_of_something_else_is_left_alone(commands, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("")
    with pytest.raises(UserError, match="is not empty and holds no demo"):
        demo(out=tmp_path / "mine")
    assert os.listdir(tmp_path / "mine") == ["thesis.tex"]
    with pytest.raises(UserError, match="is a file"):
        demo(out=tmp_path / "mine" / "thesis.tex")
    with pytest.raises(UserError, match=r"thesis.tex/demo cannot be written: Not a directory"):
        demo(out=tmp_path / "mine" / "thesis.tex" / "demo")
    assert commands.calls() == []


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"seconds": 0.0}, "--seconds is 0"),
        ({"seconds": float("nan")}, "--seconds is nan"),
        ({"seconds": float("inf")}, "--seconds is inf"),
        ({"blocks": 0}, "--blocks is 0"),
    ],
)
def test_options_out_of_range_are_refused(tmp_path, options, message):
    with pytest.raises(UserError, match=message):
        demo(out=tmp_path / "demo", **options)
    assert not (tmp_path / "demo").exists()
