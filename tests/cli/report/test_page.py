"""The report's page, from made-up runs: what it says, that it is safe, and that it needs nothing else."""

import base64
import dataclasses
import hashlib
import json
import re
import shlex
from html.parser import HTMLParser

import pytest
import torch

from abcd_ns.cli.report.charts import draw_map, draw_progress
from abcd_ns.cli.report.held_out import pick
from abcd_ns.cli.report.page import (
    block_rows,
    changed_options,
    more_figures,
    render_page,
    tiles,
    training_command,
)
from abcd_ns.cli.report.run_folder import CHECKPOINTS, RunFolder, open_run
from abcd_ns.cli.report.story import read_story
from abcd_ns.engine.space.partition import build_kd
from abcd_ns.engine.store import ParameterStore
from abcd_ns.engine.store.coarse_model import stored_blocks
from abcd_ns.engine.train.run_state import BlockHealth, RunState
from abcd_ns.lab.results.records import RecordError
from tests.cli.report.runs import (
    TRAINING,
    line,
    log_lines,
    made_up_folder,
    made_up_held_out,
    made_up_run,
    made_up_score,
    made_up_settings,
    write_log,
)
from tests.lab.compare.records import MACHINE
from tests.reference.scenes import random_gaussians

HOSTILE = "</title></style><script>alert(1)</script>\"'><img src=http://evil/x onerror=alert(2)>{{ 7*7 }}"


class Page(HTMLParser):
    """Elements, and the text of those that hold nothing else."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str]]] = []
        self.texts: dict[str, list[str]] = {"": [""]}
        self._tag = ""
        self.feed(text)

    def handle_starttag(self, tag, attrs) -> None:
        self.elements.append((tag, dict(attrs)))
        self.texts.setdefault(tag, []).append("")
        self._tag = tag

    def handle_endtag(self, _) -> None:
        self._tag = ""

    def handle_data(self, data) -> None:
        self.texts[self._tag][-1] += data

    def all(self, tag: str) -> list[dict[str, str]]:
        return [attributes for name, attributes in self.elements if name == tag]


def with_log(run: RunFolder, lines: list[str]) -> RunFolder:
    return dataclasses.replace(run, story=read_story(write_log(run.path / "other.jsonl", lines)))


@pytest.fixture(scope="module")
def shown(tmp_path_factory) -> tuple[str, Page]:
    text = render_page(made_up_run(tmp_path_factory.mktemp("page")), made_up_held_out())
    return text, Page(text)


def test_the_page_says_what_was_measured(shown, tmp_path):
    text, page = shown
    assert page.texts["h1"] == ["made-up"]
    assert page.texts["title"][0] == "made-up · abcd"
    assert page.texts["dd"][:3:2] == ["24.00 dB", "330"]
    for value in ("SSIM 0.800", "PSNR 23.50 dB", "45.0 dB", "16.0 s", "40 steps, 19% of the time for layers"):
        assert value in text
    assert "not ended: still running, or interrupted" in text
    assert "2026-01-02 03:04 UTC" in text
    # Charts and pictures are described; pictures can be compared by keyboard.
    charts = [image for image in page.all("img") if image.get("class") == "chart"]
    assert [image["alt"].split(":")[0] for image in charts] == ["Chart", "Charts", "Map of the blocks"]
    for image in charts:
        kind, _, content = image["src"].partition(";base64,")
        assert kind == "data:image/svg+xml"
        assert b"</svg>" in base64.b64decode(content)
    assert all(image["alt"] for image in page.all("img"))
    sliders = page.all("input")  # the view that the page opens with, and beside its error
    assert [slider["type"] for slider in sliders] == ["range"] * 2
    assert all("0000.png" in slider["aria-label"] for slider in sliders)
    # Without pictures the last evaluation of the log stands in.
    assert tiles(made_up_run(tmp_path), None)[0][1] == "24.50 dB"


def test_the_page_needs_nothing_else_and_runs_its_own_script_alone(shown):
    text, page = shown
    for tag, attributes in page.elements:
        for name in ("src", "href", "xlink:href", "data", "action", "srcset", "poster"):
            assert re.match(r"data:|#", attributes.get(name) or "#"), (tag, name)
    outside = re.sub(r"data:[^\"')]*", "", text)
    for word in ("@import", "http://", "https://", "fetch(", "XMLHttpRequest", "WebSocket", "url("):
        assert word not in outside
    (policy,) = (meta["content"] for meta in page.all("meta") if "http-equiv" in meta)
    digest = base64.b64encode(hashlib.sha256(page.texts["script"][0].encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in policy
    assert "default-src 'none'" in policy


def test_figures_of_workers_and_of_the_final_pruning_are_told_where_there_are_any(tmp_path):
    run = made_up_run(tmp_path)
    pruned = {"gone": 30, "gaussians": 300, "views": 5, "before": 25.0, "after": 24.96}
    ends = [{"worker": 0, "deaths": 1, "waited": 0.25}, {"worker": 1, "deaths": 0, "waited": 0.05}]
    lines = [line("worker", 40, 16.0, visits=2, **end) for end in ends]
    found = with_log(run, [*log_lines(), *lines, line("pruned at end", 40, 17.0, **pruned)])
    assert "19% of the time for layers" in tiles(found, None)[2][2]  # of the visits, whoever made them
    figures = more_figures(found, None)
    assert figures["visits"] == "4, 1 pass over all blocks"
    assert figures["workers"] == "2, waited 15% of the time, 1 lost"
    assert figures["pruned at the end"] == "30 (9%), costs 0.04 dB on 5 training views"
    assert not {"workers", "pruned at the end"} & more_figures(run, None).keys()


@pytest.mark.parametrize(("sampled", "ended", "peak"), [(3, 2, "3.00"), (1, 2, "2.00"), (3, None, "3.00")])
def test_peaks_of_memory_are_those_of_all_processes_of_a_run(tmp_path, sampled, ended, peak):
    run = made_up_run(tmp_path, machine=dataclasses.replace(MACHINE, gpu="made up"))
    memory = {"rss_bytes": sampled << 30, "device_bytes": sampled << 30}
    lines = [line("training", 0, 0.0, **TRAINING), line("sample", 5, 2.0, **memory)]
    lines += [line("training", 5, 2.0, **TRAINING)]
    if ended is not None:
        lines.append(line("end", 9, 4.0, peak_rss_bytes=ended << 30, peak_device_bytes=ended << 30))
    name, value, more = tiles(with_log(run, lines), None)[3]
    assert (name, value) == ("peak GPU memory", f"{peak} GiB")
    assert f"RAM {peak} GiB" in more


def test_names_are_text_wherever_they_come_from(tmp_path):
    options = {**made_up_settings().options, "pipeline.training.background": HOSTILE, HOSTILE: HOSTILE}
    run = made_up_run(tmp_path, scene=HOSTILE, method=HOSTILE, data=HOSTILE, options=options)
    text = render_page(run, made_up_held_out(HOSTILE), notes=[HOSTILE])
    page = Page(text)
    assert page.texts["h1"] == [HOSTILE]
    assert page.texts["title"][0].startswith(HOSTILE)
    assert len(page.all("script")) == 1
    assert not any(name.startswith("on") for _, attributes in page.elements for name in attributes)
    assert "<script>alert" not in text
    assert all(image["src"].startswith("data:") for image in page.all("img"))


def test_a_map_needs_no_gaussians_in_every_block(tmp_path):
    """Stacked blocks are seen from the side too."""
    checkpoint = made_up_run(tmp_path).checkpoint
    means = checkpoint.means * torch.tensor([1.0, 1.0, 9.0])
    few = {"_model.gauss_params.means": means[:2]}
    found = draw_map(dataclasses.replace(checkpoint, tree=build_kd(means, 3), pipeline=few), [])
    assert found.startswith("data:image/svg+xml")


def test_shown_views_reach_from_the_best_to_the_worst_and_open_with_the_median():
    scores = [made_up_score(row, psnr) for row, psnr in enumerate([21.0, 25.0, 23.0, 20.0, 24.0])]
    assert pick(scores, 2) == {1: "best", 3: "worst"}
    assert pick(scores, 3) == {1: "best", 2: "median", 3: "worst"}
    assert list(pick(scores, 7)) == [1, 4, 2, 0, 3]
    assert pick(scores, 0) == pick([], 3) == {}
    for views in range(3, 14):
        scores = [made_up_score(row, 20.0 - row) for row in range(views)]
        for wanted in (1, *range(3, views + 1)):
            words = list(pick(scores, wanted).values())
            assert len(words) == wanted
            assert words[(wanted - 1) // 2] == "median"


def test_changed_settings_and_the_command_that_sets_them():
    options = made_up_settings().options
    changed = {"pipeline.blocks": 4, "pipeline.max_seconds": 60.0, "timestamp": "now", "output_dir": "x"}
    no_flag = {"pipeline.training.recipe.visit_steps": 7}
    settings = made_up_settings(options={**options, **changed, **no_flag}, data="my data; rm -rf")
    found = {name: (value, default) for name, value, default in changed_options(settings)}
    assert found.pop("pipeline.training.recipe.visit_steps") == ("7", "0")
    assert found == {"pipeline.blocks": ("4", "0"), "pipeline.max_seconds": ("60.0", "None")}
    assert shlex.split(training_command(settings).replace("\\\n", "")) == [
        "ns-train", "abcd", "--data", "my data; rm -rf",
        "--pipeline.max-seconds", "60.0", "--pipeline.blocks", "4",
    ]  # fmt: skip
    for method in ("abcd", "abcd-paper", "abcd-monolithic", "abcd-exact", "unknown"):
        assert changed_options(made_up_settings(method)) == []
    assert training_command(made_up_settings("unknown")) == "ns-train unknown --data made-up"


def test_blocks_are_those_of_the_log_and_of_the_checkpoint(tmp_path):
    """The log does not tell when a block is cut, and a checkpoint may be older than the log."""
    run = made_up_run(tmp_path)
    older = dataclasses.replace(run, story=dataclasses.replace(run.story, blocks=4))
    assert [row[1] for row in block_rows(older)] == ["200", "200", "200", "-"]
    folder = made_up_folder(tmp_path / "run")
    assert open_run(folder).story.blocks == 3
    for blocks, known in ((2, 3), (5, 5)):
        tree = build_kd(run.checkpoint.means, blocks)
        state = {"_model._extra_state": {"tree": tree.to_json()}, **run.checkpoint.pipeline}
        (folder / CHECKPOINTS).mkdir(exist_ok=True)
        torch.save({"step": 39, "pipeline": state}, folder / CHECKPOINTS / "step-000000039.ckpt")
        found = open_run(folder)
        assert found.story.blocks == len(block_rows(found)) == known
        assert more_figures(found, None)["blocks"] == str(known)


def test_blocks_say_how_they_were_trained_or_why_not(tmp_path):
    state = RunState(health={0: BlockHealth(visits=1, pruned=1234), 1: BlockHealth()}, views={0: 4})
    run = dataclasses.replace(made_up_run(tmp_path), state=state)
    first, second, third = block_rows(run)
    assert first[:5] == ("1", "200", "1,234", "4", "1")
    assert (second[2], third[2]) == ("0", "-")
    assert (first[7], first[8]) == ("21.00 dB", "trained")
    story = dataclasses.replace(run.story, lines=run.story.lines[:6])
    rows = block_rows(dataclasses.replace(run, story=story, state=RunState(views={2: 0})))
    assert [row[-1] for row in rows] == ["trained", "not visited yet", "seen by no view, left as it was"]
    jointly = dataclasses.replace(run, story=dataclasses.replace(story, lines=story.lines[:1]))
    assert {row[-1] for row in block_rows(jointly)} == {"trained in every step"}
    without = dataclasses.replace(run, checkpoint=None)
    assert [row[:2] for row in block_rows(without)] == [("1", "-"), ("2", "-"), ("3", "-")]


def test_a_run_is_read_while_it_commits(tmp_path):
    scene = random_gaussians(6)
    tree = build_kd(scene.means, 2)
    folder = made_up_folder(tmp_path / "run")
    with ParameterStore.create(folder / "abcd/store", {"tree": tree.to_json()}) as store:
        store.commit(stored_blocks(tree, scene), state=RunState(views={0: 4, 1: 4}).to_json())
        found = open_run(folder)
    assert found.state.views == {0: 4, 1: 4}


# The log that it is made from


def test_the_time_of_a_step_lies_between_those_of_the_lines(tmp_path):
    story = read_story(write_log(tmp_path / "log.jsonl", log_lines()))
    assert [story.seconds_at(step) for step in (0, 5, 25, 99)] == [0.0, 2.0, 10.0, 16.0]


def test_blocks_that_were_cut_off_during_the_run_count(tmp_path):
    lines = log_lines()
    lines[0] = line("training", 0, 0.0, **TRAINING | {"blocks": 1})
    story = read_story(write_log(tmp_path / "log.jsonl", lines))
    assert story.blocks == 3
    assert draw_progress(story) is not None
    alone = read_story(write_log(tmp_path / "log.jsonl", lines[:1]))
    assert (alone.blocks, draw_progress(alone)) == (1, None)


def test_a_scene_that_was_cut_anew_has_the_blocks_and_visits_since(tmp_path):
    ended = {"layer_seconds": 1.0, "visit_seconds": 4.0}
    since = [line("cut anew", 40, 16.0, blocks=2), line("visit end", 50, 20.0, visit=4, block=1, **ended)]
    story = read_story(write_log(tmp_path / "log", [*log_lines(), *since]))
    assert story.blocks == 2
    assert [len(story.of_block(block)) for block in (0, 1)] == [0, 1]
    assert len(story.visits) == 5


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
