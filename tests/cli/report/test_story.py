"""Reading a run's log: what comes back, and what is refused by name."""

import json

import pytest

from abcd_ns.cli.report.charts import draw_progress
from abcd_ns.cli.report.story import read_story
from abcd_ns.lab.results.records import RecordError
from abcd_ns.nerfstudio.run.log_lines import EndLine, layer_share
from tests.cli.report.runs import TRAINING, line, log_lines, write_log


def test_a_log_tells_visits_and_totals(tmp_path):
    story = read_story(write_log(tmp_path / "log.jsonl", log_lines()))
    assert [visit.block for visit in story.visits] == [None, 0, 1, 2]
    assert layer_share(story.visits) == 3 / 16
    assert [visit.psnr for visit in story.of_block(1)] == [22.0]
    assert (story.end.step, story.end.seconds, story.blocks, story.gaussians) == (40, 16.0, 3, 330)
    assert story.last(EndLine) is None
    assert [story.seconds_at(step) for step in (0, 5, 25, 99)] == [0.0, 2.0, 10.0, 16.0]


def test_blocks_that_were_cut_off_during_the_run_count(tmp_path):
    lines = log_lines()
    lines[0] = line("training", 0, 0.0, **TRAINING | {"blocks": 1})
    story = read_story(write_log(tmp_path / "log.jsonl", lines))
    assert story.blocks == 3
    assert draw_progress(story) is not None
    alone = read_story(write_log(tmp_path / "log.jsonl", lines[:1]))
    assert (alone.blocks, draw_progress(alone)) == (1, None)


def test_a_log_cut_anywhere_is_read_up_to_its_last_whole_line(tmp_path):
    path = write_log(tmp_path / "log.jsonl", log_lines()[:6])
    whole = path.read_bytes()
    first = whole.index(b"\n") + 1
    for length in range(first, len(whole)):
        path.write_bytes(whole[:length])
        lines = whole[:length].count(b"\n")
        assert read_story(path).end.step == json.loads(whole.split(b"\n")[lines - 1])["step"]
    path.write_bytes(whole[: first - 1])
    with pytest.raises(RecordError, match="does not say when training began"):
        read_story(path)


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ("no json", "is damaged"),
        ("[1, 2]", "is of the unknown kind None"),
        ('{"kind": ["visit"]}', "is of the unknown kind"),
        (line("sample", 1, 1.0).replace("sample", "simple"), "is of the unknown kind 'simple'"),
        (line("sample", 1, 1.0).replace("rss_bytes", "rss"), "has an unknown field 'rss'"),
        (line("held out", 1, 1.0).replace("20.0", "NaN"), "is damaged"),
        (line("held out", 1, 1.0).replace("20.0", '"much"'), r"Expected float \| null, got str - at psnr"),
        (line("training", 1, 1.0, **{**TRAINING, "schema": 99}), "has schema 99"),
    ],
)
def test_a_line_that_is_none_is_named(tmp_path, bad, message):
    lines = log_lines()
    path = write_log(tmp_path / "log.jsonl", [*lines[:2], bad, *lines[2:]])
    with pytest.raises(RecordError, match=rf"{path}, line 3:? {message}"):
        read_story(path)
