"""The real command, as a user types it."""

import importlib
import json
import re
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path

import pytest
from nerfstudio.scripts.eval import ComputePSNR
from nerfstudio.scripts.train import entrypoint

from abcd_ns import methods
from abcd_ns.errors import UserError
from abcd_ns.nerfstudio.flags import check_config, check_held_out, check_tool, opens_ours, trains_ours
from abcd_ns.nerfstudio.inspection import where_data_is
from tests.reference.colmap_scene import write_scene


@pytest.mark.cli
def test_train_then_evaluate(tmp_path):
    data = write_scene(tmp_path / "wall")
    words = [
        Path(sys.executable).with_name("ns-train"), "abcd", "--data", data, "--output-dir", tmp_path / "out",
        "--timestamp", "run", "--max-num-iterations", 30, "--pipeline.blocks", 2, "--vis", "tensorboard",
        "colmap", "--colmap-path", "sparse/0",
    ]  # fmt: skip
    train = subprocess.run([*map(str, words)], capture_output=True, text=True, timeout=300, check=False)
    assert train.returncode == 0, train.stdout[-3000:] + train.stderr[-3000:]
    assert "Warning" not in train.stdout + train.stderr
    assert "training on the CPU" in train.stdout or "GPU" in train.stdout
    assert "30 steps" in train.stdout
    run = tmp_path / "out" / "wall" / "abcd" / "run"
    ComputePSNR(load_config=run / "config.yml", output_path=tmp_path / "eval.json").main()
    assert json.loads((tmp_path / "eval.json").read_text())["results"]["psnr"] > 14


def test_an_option_that_is_none_here_is_one_line_before_nerfstudio_reads_any(monkeypatch, said_at_exit):
    monkeypatch.setattr("sys.argv", ["ns-train", "abcd", "--data", "x", "--pipeline.training.warmpu", "0.1"])
    (line,) = said_at_exit(importlib.reload, methods).splitlines()  # as nerfstudio loads it
    assert line.startswith("error: There is no option --pipeline.training.warmpu; did you mean")


@pytest.mark.parametrize(
    ("line", "ours"),
    [
        ("ns-train abcd --data x", True),
        ("/venv/bin/ns-train abcd-paper", True),
        ("ns-train splatfacto --data abcd", False),
        ("ns-train", False),
        ("ns-eval --load-config outputs/fox/abcd/now/config.yml --output-path x.json", True),
        ("ns-render dataset --load-config=/a/fox/abcd-exact/now/config.yml", True),
        ("ns-viewer --load_config out/abcd/splatfacto/now/config.yml", False),
        ("ns-eval --load-config", False),
        ("pytest --load-config outputs/fox/abcd/now/config.yml", False),
    ],
)
def test_command_lines_about_our_methods_are_known(line, ours):
    words = line.split()
    assert (trains_ours(words) or opens_ours(words)) == ours


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (None, "No such file"),
        ("a: [1,", "is damaged"),
        ("- 1", "describes no run"),
        ("", "describes no run"),
        ("folder", "Is a directory"),
        ("!!python/object:abcd_ns.nerfstudio.trainer.AbcdTrainerConfig {}", ""),
    ],
)
@pytest.mark.parametrize("tool", ["ns-train abcd", "ns-eval", "ns-viewer", "ns-export gaussian-splat"])
def test_a_config_that_is_none_is_one_line_before_it_is_read(tool, content, why, tmp_path):
    path = tmp_path / "fox/abcd/now/config.yml"
    path.parent.mkdir(parents=True)
    if content not in (None, "folder"):
        path.write_text(content)
    words = [*tool.split(), "--load-config", str(path.parent if content == "folder" else path)]
    expected = pytest.raises(UserError, match=f"{why}.*give --load-config outputs/") if why else nullcontext()
    with expected:
        check_config(words)
    check_config(["ns-eval", "--load-config", "fox/splatfacto/now/config.yml"])


def test_options_beside_a_config_to_train_by_are_refused_for_nerfstudio_drops_them(tmp_path):
    path = tmp_path / "config.yml"
    path.write_text("!!python/object:abcd_ns.nerfstudio.trainer.AbcdTrainerConfig {}")
    given = ["ns-train", "abcd", f"--load-config={path}"]
    check_config(given)
    with pytest.raises(UserError, match=r"write --load-dir into .*, or leave it out"):
        check_config([*given, "--load-dir", "outputs/fox/abcd/now"])


REFUSED = {
    "ns-export poisson": "abcd mesh",
    "ns-export tsdf": "abcd mesh",
    "ns-export pointcloud": "abcd mesh",
    "ns-export marching-cubes": "abcd mesh",
    "ns-render spiral": "ns-render interpolate",
    "ns-eval --output-path scores.txt": "scores.txt must end in .json",
    "ns-eval --output-path broken.json/new/scores.json": "new cannot be made, .*broken.json is a file",
    "ns-eval --output-path out/x.json --render-output-path broken.json": "broken.json cannot be made",
    "ns-export gaussian-splat --output-dir broken.json": "broken.json cannot be made",
    "ns-render camera-path --camera-path-filename none.json": "none.json is no camera path",
    "ns-render camera-path --camera_path_filename=broken.json": "broken.json is no camera path",
}


@pytest.mark.parametrize("line", REFUSED)
def test_what_a_tool_cannot_do_with_a_run_is_said_before_it_is_opened(line, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "broken.json").write_text("{")
    with pytest.raises(UserError, match=REFUSED[line]):
        check_tool([*line.split(), "--load-config", "run/config.yml"])
    check_tool(["ns-train", "abcd", "--load-config", "run/config.yml"])


@pytest.mark.parametrize(
    ("line", "held_out", "remedy"),
    [
        ("ns-eval", 0, "nothing to score"),
        ("ns-render dataset", 0, "--split train"),
        ("ns-render interpolate --pose-source eval", 0, "--pose-source train"),
        ("ns-render dataset --split train", 0, None),
        ("ns-render camera-path", 0, None),
        ("ns-viewer", 0, None),
        ("ns-eval", 1, None),
        ("ns-render dataset", 1, None),
        ("ns-render interpolate --pose-source train", 1, None),
        ("ns-render interpolate", 1, "holds one photo out: add --pose-source train"),
    ],
)
def test_held_out_photos_are_missed_where_they_are_asked_for(line, held_out, remedy):
    """A single one is too few for a path alone."""
    with nullcontext() if remedy is None else pytest.raises(UserError, match=remedy):
        check_held_out(line.split(), held_out)


def test_data_is_found_by_the_folder_that_the_run_lies_in(tmp_path):
    data, config = tmp_path / "project/photos", tmp_path / "project/outputs/run/config.yml"
    data.mkdir(parents=True)
    assert where_data_is(Path("photos"), config) == data
    assert where_data_is(None, config) is None
    with pytest.raises(UserError, match="ln -s NEW_PLACE /gone"):
        where_data_is(Path("/gone"), config)


def test_a_wrong_folder_is_one_line_and_nothing_is_written(tmp_path, monkeypatch, said_at_exit):
    out = tmp_path / "out"
    words = ["ns-train", "abcd", "--data", tmp_path / "garden", "--output-dir", out]
    monkeypatch.setattr("sys.argv", [*map(str, words)])
    said = said_at_exit(entrypoint)
    assert re.search("error: .*garden", said)
    assert "Traceback" not in said
    assert not out.exists()
