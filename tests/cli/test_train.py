"""`abcd train`: what is in the file is what `ns-train` is told."""

import os
from pathlib import Path

import pytest
import tyro
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion

from abcd_ns.cli import main as cli
from abcd_ns.cli import train
from abcd_ns.errors import UserError
from abcd_ns.lab.results.records import own_configs


@pytest.fixture
def told(monkeypatch):
    """The command lines that would have taken the process's place."""
    found = []
    monkeypatch.setattr(os, "execv", lambda _, words: found.append(words[1:]))
    return found


def test_tables_become_dotted_names_and_later_words_count(tmp_path, told, capsys):
    assert cli.main(["train"]) == cli.main(["train", "--help"]) == 0
    assert capsys.readouterr().out.count("abcd train small-gpu") == 2
    assert not told
    path = tmp_path / "mine.toml"
    path.write_text('method = "abcd"\nvis = "tensorboard"\n[pipeline.training]\nbatch = 2\nwarmup = 0.5\n')
    cli.main(["train", str(path), "--data", "garden"])
    options = "--vis tensorboard --pipeline.training.batch 2 --pipeline.training.warmup 0.5"
    assert told == [["abcd", *options.split(), "--data", "garden"]]


@pytest.mark.parametrize("path", own_configs(trains=True), ids=lambda path: path.stem)
def test_ns_train_takes_every_file_in_configs(path):
    words = train.command_line(path)
    config = tyro.cli(AnnotatedBaseConfigUnion, args=[*words, "--pipeline.max-seconds", "77"])
    assert config.method_name == words[0] == "abcd"
    assert config.pipeline.max_seconds == 77
    assert config.pipeline.datamanager.dataparser.max_side == (320 if path.stem == "cpu" else 0)
    assert f"abcd train {path.stem} --data" in path.read_text()


def test_those_that_come_with_abcd_go_by_name_from_anywhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    named = [train.command_line(Path(name)) for name in ("cpu", "cpu.toml", "configs/cpu.toml")]
    assert named[0] == named[1] == named[2]
    (tmp_path / "cpu.toml").write_text('method = "abcd-exact"\n')
    assert train.command_line(Path("cpu.toml")) == ["abcd-exact"]  # one's own goes first
    with pytest.raises(UserError, match=r"compare-castle.*: cpu, garden, small-gpu"):
        train.command_line(Path("compare-castle"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("blocks = 3", "names no method"),
        ("method = 3", "names no method"),
        ("method = ", "cannot be read as TOML"),
        ('method = "abcd"\n[pipeline]\nblocks = [1, 2]', "blocks is a list"),
    ],
)
def test_a_bad_file_is_refused_in_one_line(tmp_path, told, text, message):
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(UserError, match=message) as caught:
        train.train([str(path)])
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not told
