"""The log that every run writes: what is in it, what a resumed run keeps of it, what it survives."""

import errno
import json
import math
import os
from collections import Counter
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest

from abcd_ns.engine.events import EpochEnded, StepTaken, VisitBegan, VisitEnded
from abcd_ns.errors import UserError
from abcd_ns.nerfstudio.run import run_log, settings
from abcd_ns.nerfstudio.run.run_log import LOG_FILE, RunLog
from abcd_ns.nerfstudio.run.settings import flat_options
from abcd_ns.run import SETTINGS_FILE
from tests.nerfstudio.test_training import STEPS, configure, run

PHOTOS = SimpleNamespace(cached_bytes=7, budget_bytes=10)


def coordinator_at(step: int = 0, seconds: float = 0.0) -> SimpleNamespace:
    """All that a log asks a coordinator for."""
    config = SimpleNamespace(density=SimpleNamespace(limit=None))
    scene = SimpleNamespace(tree=SimpleNamespace(num_blocks=2), cached_bytes=0, ram_bytes=0)
    parts = {"config": config, "scene": scene, "count": lambda: 100, "layer_bytes": 0, "layer_limit": 0}
    found = SimpleNamespace(step=step, seconds=seconds, visit=0, **parts)
    found.state = found.stopwatch = found
    return found


def lines_of(path: Path, kind: str | None = None) -> list[dict]:
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    return [line for line in lines if kind in (None, line["kind"])]


def take_steps(log: RunLog, count: int, seconds: float, psnr: float = 20.0):
    coordinator = log._coordinator
    for _ in range(count):
        coordinator.step += 1
        coordinator.seconds += seconds
        log(StepTaken(coordinator.step, 0, coordinator.step, psnr))


@pytest.fixture
def path(tmp_path) -> Path:
    return tmp_path / "log.jsonl"


@pytest.fixture
def log(path) -> RunLog:
    return RunLog(coordinator_at(), PHOTOS, path)


@pytest.fixture(scope="module")
def trained(data, tmp_path_factory):
    return run(configure(data, tmp_path_factory.mktemp("out"), steps_per_eval_all_images=15))


def test_a_disk_that_is_full_at_the_start_is_one_line(tmp_path, monkeypatch):
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    monkeypatch.setattr(settings, "write_file", Mock(side_effect=full))
    with pytest.raises(UserError, match=r"No space left on device\): free space"):
        settings.write_settings(configure(tmp_path, tmp_path), {}, tmp_path)


def test_a_run_tells_its_visits_its_evaluations_and_its_end(trained):
    path = trained.base_dir / "abcd" / LOG_FILE
    lines = lines_of(path)
    kinds = Counter(line["kind"] for line in lines)
    assert [lines[0]["kind"], lines[-1]["kind"]] == ["training", "end"]
    assert kinds["visit"] == kinds["visit end"] == trained.pipeline.coordinator.state.visit
    assert kinds["held out"] == 3  # after steps 15 and 30, and at the end
    assert {line["block"] for line in lines_of(path, "visit end")} == {None, 0, 1, 2}
    for name in ("step", "seconds"):
        values = [line[name] for line in lines]
        assert values == sorted(values)
    assert lines[-1]["step"] == STEPS
    assert lines[-1]["gaussians"] == trained.pipeline.coordinator.count()
    assert all(line["psnr"] > 5 for kind in ("visit end", "held out") for line in lines_of(path, kind))
    sample = lines_of(path, "sample")[-1]
    assert sample["rss_bytes"] > 100 << 20
    assert sample["held"]["photos"] > 0
    assert sample["held"].keys() == lines[0]["budgets"].keys()


def test_settings_are_plain_values_of_every_option(trained):
    written = json.loads((trained.base_dir / "abcd" / SETTINGS_FILE).read_text())
    assert (written["method"], written["scene"]) == ("abcd", "wall")
    options = written["options"]
    follows = {"pipeline.datamanager.photo_cache_gb": 0.0, "pipeline.datamanager.dataparser.data": "."}
    assert options == flat_options(trained.config) | follows  # as they were asked for
    assert not any("_target" in name for name in options)


def test_a_resumed_run_has_the_past_up_to_where_it_goes_on_and_no_more(data, tmp_path, trained):
    stop_after = 27
    broken = run(configure(data, tmp_path / "broken"), stop_after=stop_after)
    resumed = run(configure(data, tmp_path / "broken", load_dir=broken.checkpoint_dir))  # in its own folder
    path = resumed.base_dir / "abcd" / LOG_FILE
    lines = lines_of(path)
    went_on = resumed.resumed_from.step
    assert stop_after // 10 * 10 + 1 <= went_on <= stop_after
    assert [line["step"] for line in lines_of(path, "training")] == [0, went_on]
    for name in ("step", "seconds"):
        values = [line[name] for line in lines]
        assert values == sorted(values)
    undisturbed = trained.base_dir / "abcd" / LOG_FILE
    for kind in ("visit", "visit end"):
        found, expected = (
            [(line["visit"], line["block"], line["step"]) for line in lines_of(each, kind)]
            for each in (path, undisturbed)
        )
        assert found == expected
    assert len(lines_of(path, "end")) == 1
    assert len({json.dumps(line) for line in lines}) == len(lines)


def test_a_torn_or_foreign_past_is_kept_as_far_as_it_can_be_read(log, path, tmp_path):
    take_steps(log, 5, seconds=1.0)
    log.close()
    whole, readable = path.read_bytes(), lines_of(path)[:-1]
    path.write_bytes(whole[: whole.rindex(b'{"kind": "end"') + 9] + b"\xff")
    RunLog(coordinator_at(step=5, seconds=5.0), PHOTOS, tmp_path / "new.jsonl", earlier=path)
    assert lines_of(tmp_path / "new.jsonl")[:-1] == readable
    RunLog(coordinator_at(step=5), PHOTOS, tmp_path / "without.jsonl", earlier=tmp_path / "absent.jsonl")
    assert [line["step"] for line in lines_of(tmp_path / "without.jsonl")] == [5]


def test_samples_thin_out_so_that_a_long_run_has_a_short_log(log, path):
    take_steps(log, 4 * 3600, seconds=1.0)
    log.close()
    times = [line["seconds"] for line in lines_of(path, "sample")]
    gaps = [later - earlier for earlier, later in pairwise(times)]
    assert gaps[0] == 1.0
    assert max(gaps) == pytest.approx(4 * 3600 / run_log.SAMPLES, rel=0.05)
    assert len(times) < 2000


def test_the_psnr_of_a_visit_is_that_of_its_later_half(log, path):
    log(VisitBegan(0, 0, 1, steps=4, views=4, gaussians=50))
    for psnr in (10.0, 12.0, 20.0, 22.0):
        take_steps(log, 1, seconds=0.1, psnr=psnr)
    log(VisitEnded(0, 0, 1, gaussians=50, migrated=2, layer_seconds=0.1, visit_seconds=0.4))
    log(EpochEnded(0, 4))
    log.close()
    (ended,) = lines_of(path, "visit end")
    assert (ended["psnr"], ended["visit_seconds"], ended["migrated"]) == (21.0, 0.4, 2)


def test_a_visit_is_on_disk_when_it_has_ended_and_a_long_one_before(log, path):
    take_steps(log, 10, seconds=1.0)
    assert len(lines_of(path)) == 1
    log(VisitEnded(0, 0, 1, gaussians=50, migrated=0, layer_seconds=0.1, visit_seconds=0.4))
    before = lines_of(path)
    assert before[-1]["kind"] == "visit end"
    take_steps(log, 2 * run_log.LINES_KEPT, seconds=1.0)
    assert len(lines_of(path)) > len(before)


def test_a_disk_that_refuses_the_log_is_named_once_and_training_goes_on(tmp_path, capsys):
    log = RunLog(coordinator_at(), PHOTOS, tmp_path / "gone" / "log.jsonl")
    take_steps(log, 200, seconds=1.0)
    log.close()
    printed = capsys.readouterr().out
    assert printed.count("cannot be written") == 1
    assert "log.jsonl" in printed.replace("\n", "")


def test_samples_hold_the_mean_psnr_since_the_last_and_pass_over_what_is_no_number(log, path, tmp_path):
    for psnr in (10.0, math.nan, 20.0, math.inf):
        take_steps(log, 1, seconds=0.3, psnr=psnr)
    take_steps(log, 4, seconds=0.3, psnr=math.nan)
    log.close()
    samples = lines_of(path, "sample")
    assert [line["psnr"] for line in samples] == [15.0, None, None]
    assert samples[0]["held"]["photos"] == 7
    again = RunLog(log._coordinator, PHOTOS, tmp_path / "again.jsonl", earlier=path)
    assert log.curve == again.curve == [(samples[0]["seconds"], 15.0)]
