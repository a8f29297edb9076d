"""The report's page, from made-up runs: what it says, that it is safe, and that it needs nothing else."""

import base64
import dataclasses
import hashlib
import re
import shlex
from html.parser import HTMLParser

import numpy as np
import pytest
import torch

from abcd_ns.cli.report import held_out as held_out_module
from abcd_ns.cli.report.blocks import describe_blocks
from abcd_ns.cli.report.charts import smoothed
from abcd_ns.cli.report.headline import headline
from abcd_ns.cli.report.held_out import HeldOut, data_uri, pick
from abcd_ns.cli.report.options import changed_options, training_command
from abcd_ns.cli.report.page import render_page, sparkline
from abcd_ns.cli.report.plan import make_plan, push_apart
from abcd_ns.cli.report.run_folder import CHECKPOINTS, open_run
from abcd_ns.cli.report.story import read_story
from abcd_ns.cli.report.svg import DARK
from abcd_ns.engine.gaussians.spherical_harmonics import count_parameters
from abcd_ns.engine.space.partition import build_kd
from abcd_ns.engine.store import ParameterStore
from abcd_ns.engine.store.scaffold import blocks_at_rest
from abcd_ns.engine.train.health_record import BlockHealth
from abcd_ns.engine.train.run_state import RunState
from abcd_ns.lab.runs.evaluate import Drawn, HeldOutView
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
from tests.reference.scenes import random_gaussians

HOSTILE = "</title></style><script>alert(1)</script>\"'><img src=http://evil/x onerror=alert(2)>{{ 7*7 }}"


class Page(HTMLParser):
    """Elements, and the text in each kind of them."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str]]] = []
        self.texts: dict[str, list[str]] = {}
        self._open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs) -> None:
        self.elements.append((tag, dict(attrs)))
        self.texts.setdefault(tag, []).append("")
        self._open.append(tag)

    def handle_startendtag(self, tag, attrs) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag) -> None:
        if tag in self._open:
            while self._open.pop() != tag:
                pass

    def handle_data(self, data) -> None:
        for tag in set(self._open):
            self.texts[tag][-1] += data

    def all(self, tag: str) -> list[dict[str, str]]:
        return [attributes for name, attributes in self.elements if name == tag]


def page_of(tmp_path, held_out: HeldOut | None = None, notes=(), **settings) -> tuple[str, Page]:
    run = made_up_run(tmp_path, **settings)
    plan = make_plan(run.checkpoint.tree, run.checkpoint.means)
    text = render_page(run, held_out, plan, list(notes))
    return text, Page(text)


@pytest.fixture(scope="module")
def shown(tmp_path_factory) -> tuple[str, Page]:
    """The page of a run, with pictures."""
    return page_of(tmp_path_factory.mktemp("page"), made_up_held_out())


def test_the_headline_says_what_was_measured(shown):
    text, page = shown
    assert page.texts["h1"] == ["made-up"]
    said = [re.sub(r"\s+", " ", found).strip() for found in page.texts["dd"]]
    for value in ("24.00dB", "composited 23.50", "0.800", "45.0dB", "330", "40", "16.0 s", "19% for layers"):
        assert value in said
    assert "not ended: still running, or broken off" in text
    assert "2026-01-02 03:04 UTC" in text


def test_the_headline_counts_workers_where_there_were_any(tmp_path):
    run = made_up_run(tmp_path)
    ends = [{"worker": 0, "deaths": 1, "waited": 0.25}, {"worker": 1, "deaths": 0, "waited": 0.05}]
    lines = [*log_lines(), *(line("worker", 40, 16.0, visits=2, **end) for end in ends)]
    story = read_story(write_log(tmp_path / "workers.jsonl", lines))
    facts = {fact.name: fact for fact in headline(dataclasses.replace(run, story=story), None)}
    assert facts["training time"].more == "9% for layers"  # of two workers' time: half of one process's 19%
    assert (facts["workers"].value, facts["workers"].more) == ("2", "waited 15% of the time, 1 lost")
    assert "workers" not in {fact.name for fact in headline(run, None)}


@pytest.mark.parametrize(("sampled", "ended", "peak"), [(3, 2, "3.00"), (1, 2, "2.00"), (3, None, "3.00")])
def test_peaks_of_memory_are_those_of_all_processes_of_a_run(tmp_path, sampled, ended, peak):
    run = made_up_run(tmp_path)
    machine = dataclasses.replace(run.settings.machine, gpu="made up")
    memory = {"rss_bytes": sampled << 30, "device_bytes": sampled << 30, "held": {}}
    lines = [line("training", 0, 0.0, **TRAINING), line("sample", 5, 2.0, **memory)]
    lines += [line("training", 5, 2.0, **TRAINING)]
    if ended is not None:
        lines.append(line("end", 9, 4.0, peak_rss_bytes=ended << 30, peak_device_bytes=ended << 30))
    story = read_story(write_log(tmp_path / "memory.jsonl", lines))
    settings = dataclasses.replace(run.settings, machine=machine)
    facts = headline(dataclasses.replace(run, story=story, settings=settings), None)
    found = {fact.name: fact.value for fact in facts}
    assert (found["peak RAM"], found["peak GPU memory"]) == (peak, peak)


def test_without_pictures_the_last_evaluation_of_the_log_stands_in(tmp_path):
    text, page = page_of(tmp_path, None, ["the photos are gone"])
    assert "24.50dB" in [found.strip() for found in page.texts["dd"]]
    assert "the photos are gone" in text
    assert page.all("img") == []


def test_names_are_text_wherever_they_come_from(tmp_path):
    options = {**made_up_settings().options, "pipeline.training.background": HOSTILE, HOSTILE: HOSTILE}
    hostile = {"scene": HOSTILE, "method": HOSTILE, "data": HOSTILE, "options": options}
    text, page = page_of(tmp_path, made_up_held_out(HOSTILE), [HOSTILE], **hostile)
    assert page.texts["h1"] == [HOSTILE]
    assert page.texts["title"][0].startswith(HOSTILE)
    assert len(page.all("script")) == 1
    assert not any(name.startswith("on") for _, attributes in page.elements for name in attributes)
    assert "<script>alert" not in text
    assert all(image["src"].startswith("data:") for image in page.all("img"))


def test_nothing_is_fetched_from_anywhere(shown):
    text, page = shown
    for tag, attributes in page.elements:
        for name in ("src", "href", "xlink:href", "data", "action", "srcset", "poster"):
            assert re.match(r"data:|#", attributes.get(name) or "#"), (tag, name)
    outside = re.sub(r"data:[^\"')]*", "", text)
    assert "url(" not in re.sub(r"url\(#", "", outside)
    for word in ("@import", "http://", "https://", "fetch(", "XMLHttpRequest", "WebSocket"):
        assert word not in outside


def test_only_the_pages_own_script_may_run(shown):
    _, page = shown
    (policy,) = (meta["content"] for meta in page.all("meta") if "http-equiv" in meta)
    digest = base64.b64encode(hashlib.sha256(page.texts["script"][0].encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in policy
    assert "default-src 'none'" in policy


def test_ids_are_unique_and_references_lead_somewhere(shown):
    text, page = shown
    ids = [attributes["id"] for _, attributes in page.elements if "id" in attributes]
    assert len(ids) == len(set(ids))
    wanted = re.findall(r"url\(#([^)]+)\)", text) + re.findall(r'href="#([^"]+)"', text)
    wanted += [attributes["aria-labelledby"] for attributes in page.all("section")]
    assert wanted
    assert set(wanted) <= set(ids)


def test_charts_are_all_there_and_follow_the_theme(shown):
    text, page = shown
    labels = [svg["aria-label"] for svg in page.all("svg") if svg.get("class") != "spark"]
    for title in ("Quality", "Visits", "Gaussians", "Quality by block", "Memory", "Budgets", "From above"):
        assert any(label.startswith(f"Chart: {title}.") for label in labels)
    for light, dark in DARK.items():
        assert f"--c-{light[1:]}: {dark};" in text
    drawn = "".join(re.findall(r"<svg.*?</svg>", text, re.DOTALL))
    assert re.findall(r"(?:stroke|fill): #000000", drawn) == []
    assert "var(--c-0072b2, #0072b2)" in drawn


def test_a_visit_says_what_it_was_where_the_pointer_is(shown):
    _, page = shown
    assert "block 2, sweep 1: 4.0 s from 8.0 s on, 25% of it for layers, 22.00 dB" in page.texts["title"]
    assert "warm-up of the whole scene, 4.0 s" in page.texts["title"]


def test_pictures_can_be_compared_by_keyboard_and_are_described(shown):
    _, page = shown
    (slider,) = page.all("input")
    assert slider["type"] == "range"
    assert "0000.png" in slider["aria-label"]
    assert all(image["alt"] for image in page.all("img"))


def test_blocks_have_a_row_each(shown):
    _, page = shown
    rows = [re.sub(r"\s+", " ", found) for found in page.texts["tr"]]
    assert sum("trained" in row and "200" in row for row in rows) == 3


@pytest.mark.parametrize("count", [1, 2, 3, 4, 7])
def test_shown_views_reach_from_the_best_to_the_worst(count):
    scores = [made_up_score(row, psnr) for row, psnr in enumerate([21.0, 25.0, 23.0, 20.0, 24.0])]
    found = pick(scores, count)
    if count == 1:
        assert found == {2: "median"}
    else:
        rows = list(found)
        assert (rows[0], rows[-1]) == (1, 3)
        assert (found[1], found[3]) == ("best", "worst")
        ranks = [scores[row].psnr_merged for row in rows]
        assert ranks == sorted(ranks, reverse=True)
    assert len(found) == min(count, 5)
    assert pick(scores, 0) == {}
    assert pick([], 3) == {}


def test_pictures_of_a_page_are_reduced_to_a_few_megapixels(monkeypatch):
    monkeypatch.setattr(held_out_module, "PAGE_PIXELS", 3 * 2 * 100)
    noise = torch.rand(40, 60, 3, generator=torch.Generator().manual_seed(0))
    drawn = Drawn(HeldOutView(0, "a.png", None, noise), noise, noise)
    shown = held_out_module._show(drawn, made_up_score(0, 20.0), "best", 2)
    assert shown.width * shown.height <= 110
    assert shown.width / shown.height == pytest.approx(1.5, rel=0.15)


@pytest.mark.parametrize("lossless", [True, False])
def test_pictures_stand_in_the_page_itself(lossless):
    picture = np.full((8, 8, 3), 200, np.uint8)
    kind, _, content = data_uri(picture, lossless).partition(";base64,")
    assert kind == f"data:image/{'png' if lossless else 'jpeg'}"
    assert base64.b64decode(content)[:2] == (b"\x89P" if lossless else b"\xff\xd8")


def test_changed_settings_and_the_command_that_sets_them():
    options = made_up_settings().options
    changed = {"pipeline.blocks": 4, "pipeline.max_seconds": 60.0, "timestamp": "now", "output_dir": "x"}
    no_flag = {"pipeline.training.recipe.visit_steps": 7}
    settings = made_up_settings(options={**options, **changed, **no_flag}, data="my data; rm -rf")
    found = {option.name: (option.value, option.default) for option in changed_options(settings)}
    assert found.pop("pipeline.training.recipe.visit_steps") == ("7", "0")
    assert found == {"pipeline.blocks": ("4", "0"), "pipeline.max_seconds": ("60.0", "None")}
    assert shlex.split(training_command(settings).replace("\\\n", "")) == [
        "ns-train", "abcd", "--data", "my data; rm -rf",
        "--pipeline.blocks", "4", "--pipeline.max-seconds", "60.0",
    ]  # fmt: skip


@pytest.mark.parametrize("method", ["abcd", "abcd-paper", "abcd-monolithic", "abcd-exact"])
def test_a_method_as_it_is_has_no_changed_settings(method):
    assert changed_options(made_up_settings(method)) == []


def test_an_unknown_method_is_told_without_defaults():
    settings = made_up_settings("my-own")
    assert changed_options(settings) == []
    assert training_command(settings) == "ns-train my-own --data made-up"


def test_blocks_say_what_their_gaussians_are_and_fill_and_how_many_were_shed(tmp_path):
    state = RunState(health={0: BlockHealth(visits=1, shed=1234), 1: BlockHealth()}, views={0: 4})
    known = {"filled": {0: 12.34}, "parameters": {0: 5678, 1: 9}}
    run = dataclasses.replace(made_up_run(tmp_path), state=state, **known)
    page = Page(render_page(run, None, None, []))
    cells = page.texts["td"][: 3 * 11]
    first, second, third = (cells[row + 1 : row + 4] for row in range(0, 33, 11))
    assert (first, second) == (["5,678", "12.3 px", "1,234"], ["9", "-", "0"])
    assert third == ["-", "-", "-"]
    each = 5687 / len(run.checkpoint.means)
    assert any(
        fact.value == "5,687" and f"{each:.1f} a Gaussian" in fact.more for fact in headline(run, None)
    )


def test_what_gaussians_fill_is_the_weight_that_was_added_up_over_the_views(tmp_path):
    """Three pixels in half a pass over the views: six in all. Who was never drawn does not count."""
    scene = random_gaussians(6)
    tree = build_kd(scene.means, 2)
    rest = blocks_at_rest(tree, scene)
    tensors, meta = rest[0]
    count = len(tensors["means"])
    passes = torch.full((count,), 0.5).index_fill(0, torch.tensor([0]), 0.0)
    rest[0] = ({**tensors, "growth.weight": torch.full((count,), 3.0), "growth.passes": passes}, meta)
    folder = made_up_folder(tmp_path / "run")
    with ParameterStore.create(folder / "abcd/store", {"tree": tree.to_json()}) as store:
        store.commit(rest, state=RunState(views={0: 4, 1: 4}).to_json())
    found = open_run(folder)
    assert found.filled == {0: 6.0}
    assert sum(found.parameters.values()) == count_parameters(scene.features_rest)


def test_a_run_that_commits_while_its_blocks_are_read_has_a_page(tmp_path, monkeypatch):
    """Without a checkpoint nothing keeps what is at rest: a commit takes the shards from under a reader."""
    scene = random_gaussians(6)
    tree = build_kd(scene.means, 2)
    folder = made_up_folder(tmp_path / "run")
    load = ParameterStore.load
    with ParameterStore.create(folder / "abcd/store", {"tree": tree.to_json()}) as store:
        store.commit(blocks_at_rest(tree, scene), state=RunState(views={0: 4, 1: 4}).to_json())

        def commit_then_load(reader: ParameterStore, *args):
            store.commit(blocks_at_rest(tree, scene))
            return load(reader, *args)

        monkeypatch.setattr(ParameterStore, "load", commit_then_load)
        found = open_run(folder)
    assert found.filled == {}
    assert list(found.parameters) == [0, 1]


def test_blocks_are_those_of_the_log_and_of_the_checkpoint(tmp_path):
    """The log does not tell when a block is cut, and a checkpoint may be older than the log."""
    run = made_up_run(tmp_path)
    older = dataclasses.replace(run, story=dataclasses.replace(run.story, blocks=4))
    assert [block.gaussians for block in describe_blocks(older)] == [200, 200, 200, None]
    folder = made_up_folder(tmp_path / "run")
    assert open_run(folder).story.blocks == 3
    for blocks, known in ((2, 3), (5, 5)):
        tree = build_kd(run.checkpoint.means, blocks)
        state = {"_model._extra_state": {"tree": tree.to_json()}, **run.checkpoint.pipeline}
        (folder / CHECKPOINTS).mkdir(exist_ok=True)
        torch.save({"step": 39, "pipeline": state}, folder / CHECKPOINTS / "step-000000039.ckpt")
        found = open_run(folder)
        assert found.story.blocks == len(describe_blocks(found)) == known
        assert {fact.name: fact.value for fact in headline(found, None)}["blocks"] == str(known)


def test_states_of_blocks_say_why_one_was_not_trained(tmp_path):
    run = made_up_run(tmp_path)
    story = dataclasses.replace(run.story, visits=run.story.visits[:2])
    assert [block.state for block in describe_blocks(dataclasses.replace(run, story=story))] == [
        "trained", "in the warm-up only", "in the warm-up only",
    ]  # fmt: skip
    jointly = dataclasses.replace(run, story=dataclasses.replace(story, visits=()))
    assert {block.state for block in describe_blocks(jointly)} == {"trained in every step"}
    without = dataclasses.replace(run, checkpoint=None)
    assert [(block.number, block.gaussians) for block in describe_blocks(without)] == [
        (1, None), (2, None), (3, None),
    ]  # fmt: skip


def test_numbers_on_the_plan_do_not_cover_each_other():
    places = push_apart([np.zeros(2)] * 5 + [np.ones(2)], 0.1)
    distances = np.linalg.norm(places[:, None] - places[None], axis=2)[np.triu_indices(6, 1)]
    assert distances.min() > 0.09
    assert np.linalg.norm(places[5] - 1) < 0.01


def test_smoothing_keeps_the_ends_and_a_straight_line():
    points = [(float(k), 2.0 * k) for k in range(100)]
    assert smoothed(points) == [(x, pytest.approx(y)) for x, y in points]
    assert smoothed([(0.0, 5.0)]) == [(0.0, 5.0)]


def test_a_sparkline_rises_where_values_do():
    (points,) = re.findall(r'points="([^"]+)"', sparkline([20.0, 24.0]))
    (_, first), (_, last) = (map(float, point.split(",")) for point in points.split())
    assert last < first
    assert sparkline([]) == ""
    assert "nan" not in sparkline([20.0])
    (noise,) = re.findall(r'points="([^"]+)"', sparkline([20.0, 20.01]))
    heights = [float(point.split(",")[1]) for point in noise.split()]
    assert abs(heights[0] - heights[1]) < 1


def test_means_by_block_are_those_that_a_search_finds():
    means = torch.randn(300, 3, generator=torch.Generator().manual_seed(0))
    plan = make_plan(build_kd(means, 7), means[:40])
    for block, found in enumerate(plan.by_block):
        assert np.array_equal(found, plan.means[plan.owner == block])
    assert len(plan.by_block) == 7
