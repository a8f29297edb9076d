"""The real command, as a user types it."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from nerfstudio.scripts.eval import ComputePSNR
from nerfstudio.scripts.train import entrypoint

from abcd_ns.nerfstudio.flags import opens_ours, trains_ours
from tests.reference.colmap_scene import write_scene

BIN = Path(sys.executable).parent


def shell(command: str, *args: object) -> subprocess.CompletedProcess[str]:
    words = [str(BIN / command), *map(str, args)]
    return subprocess.run(words, capture_output=True, text=True, timeout=300, check=False)


@pytest.mark.cli
def test_train_then_evaluate(tmp_path):
    data = write_scene(tmp_path / "wall")
    train = shell(
        "ns-train", "abcd", "--data", data, "--output-dir", tmp_path / "out", "--timestamp", "run",
        "--max-num-iterations", 30, "--pipeline.blocks", 2, "--vis", "tensorboard",
        "colmap", "--colmap-path", "sparse/0",
    )  # fmt: skip
    assert train.returncode == 0, train.stdout[-3000:] + train.stderr[-3000:]
    assert "Warning" not in train.stdout + train.stderr
    assert "training on the CPU" in train.stdout or "GPU" in train.stdout
    assert "30 steps" in train.stdout
    run = tmp_path / "out" / "wall" / "abcd" / "run"
    ComputePSNR(load_config=run / "config.yml", output_path=tmp_path / "eval.json").main()
    assert json.loads((tmp_path / "eval.json").read_text())["results"]["psnr"] > 14


@pytest.mark.cli
@pytest.mark.parametrize(
    ("table", "says"),
    [
        ("pipeline.model]\nstop-split-at = 99", "--pipeline.model.stop-split-at has no effect here"),
        ("pipeline.training]\nwarmpu = 0.1", "There is no option --pipeline.training.warmpu; did you mean"),
    ],
)
def test_an_option_of_a_file_that_is_none_here_is_one_line(tmp_path, table, says):
    path = tmp_path / "mine.toml"
    path.write_text(f'method = "abcd"\n[{table}\n')
    ended = shell("abcd", "train", path, "--data", "x")
    assert ended.returncode == 2
    (line,) = (ended.stdout + ended.stderr).splitlines()
    assert line.startswith(f"error: {says}")


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


def test_a_wrong_folder_is_one_line_and_nothing_is_written(tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    words = ["ns-train", "abcd", "--data", tmp_path / "garden", "--output-dir", out]
    monkeypatch.setattr("sys.argv", [*map(str, words)])
    with pytest.raises(SystemExit) as ended:
        entrypoint()
    printed = capsys.readouterr()
    assert ended.value.code == 2
    assert "error:" in printed.out
    assert "garden" in printed.out
    assert "Traceback" not in printed.out + printed.err
    assert not out.exists()
