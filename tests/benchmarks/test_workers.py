"""What workers bring and what kills cost is measured on a small run, and kills leave no trace in it."""

import os

import pytest

from abcd_ns.cluster.dispatcher import Dispatcher
from abcd_ns.cluster.lease import Lost
from abcd_ns.engine.train.training_loop import train
from benchmarks import workers
from benchmarks.workers import Args, Row, Watch, main, table_of_kills
from tests.cluster.conftest import in_process
from tests.reference.colmap_scene import write_scene
from tests.reference.crash_runs import digest
from tests.reference.scenes import Photos, make_coordinator, random_gaussians, ring_of_views


class Mortal:
    """Workers in this process, who are lost when their "process" was killed."""

    def __init__(self, inner, idle: int = 0) -> None:
        self._inner, self._idle, self.killed = inner, idle, False

    @property
    def pids(self) -> list[int]:
        """None at the first `idle` times, as between visits."""
        self._idle -= 1
        return [] if self._idle >= 0 else [1, 2]

    def __getattr__(self, name):
        return getattr(self._inner, name)

    def wait(self, seconds):
        reports = self._inner.wait(seconds)
        if self.killed and reports:
            self.killed = False
            return [Lost(report.lease, "killed") for report in reports]
        return reports


@pytest.fixture(scope="module")
def scene():
    views = ring_of_views(8)
    return views, Photos(random_gaussians(60, seed=1), views)


def trained(folder, scene, monkeypatch, kills: int, idle: int = 0) -> Row:
    views, photos = scene
    folder.mkdir()

    def kind(run):
        return Dispatcher(run, Mortal(in_process(run, photos, 2), idle))

    options = {"blocks": 4, "steps": 40, "visit_steps": 5, "kind": kind}
    run = make_coordinator(folder, random_gaussians(90, seed=2), views, **options)
    monkeypatch.setattr(os, "kill", lambda *_: setattr(run.workers, "killed", True))
    row = Row(2)
    run.announce.subscribe(Watch(row, run, kills, seed=0))
    train(run, photos)
    run.save()
    run.close()
    row.steps, row.digest = run.state.step, digest(folder)
    return row


def test_every_kill_has_its_cost_and_leaves_no_trace(tmp_path, scene, monkeypatch):
    calm = trained(tmp_path / "calm", scene, monkeypatch, 0)
    row = trained(tmp_path / "killed", scene, monkeypatch, 2)
    assert not calm.kills
    assert len(row.kills) == 2
    assert all(0 <= kill.seconds_to_notice <= kill.seconds_to_lend for kill in row.kills)
    assert all(kill.block is not None for kill in row.kills)
    assert [kill.step for kill in row.kills] == sorted(kill.step for kill in row.kills)
    assert (row.steps, row.visits) == (40, 8)
    assert row.is_whole
    table = table_of_kills(row, calm)
    assert sum(line.startswith("| ") for line in table.splitlines()) == 4
    assert "each visit was taken in once" in table
    assert "the same to the last bit" in table


def test_a_kill_waits_until_a_worker_is_out(tmp_path, scene, monkeypatch):
    row = trained(tmp_path / "idle", scene, monkeypatch, 1, idle=3)
    at_once = trained(tmp_path / "at once", scene, monkeypatch, 1)
    assert len(row.kills) == len(at_once.kills) == 1
    assert row.kills[0].step >= at_once.kills[0].step
    assert row.is_whole


def test_what_is_lost_or_there_twice_is_told():
    calm = Row(2, ended=[0, 1, 2], digest="a")
    assert "ANOTHER" in table_of_kills(Row(2, ended=[0, 1, 2], digest="b"), calm)
    assert "taken in once" in table_of_kills(Row(2, ended=[0, 2, 1], digest="a"), calm)
    for ended in ([0, 2], [0, 1, 1, 2]):
        assert "MISSING" in table_of_kills(Row(2, ended=ended, digest="a"), calm)


def test_a_run_of_one_worker_is_measured(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(workers, "apart", lambda work, *args: work(*args))
    out = tmp_path / "out.json"
    scene = write_scene(tmp_path / "scene")
    main(Args(data=scene, downscale=1, workers=(1,), blocks=2, steps=12, kills=2, out=out))
    (row,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| 1 |")]
    assert row.split(" | ")[4] == "12"
    assert '"kills": []' in out.read_text()


def test_kills_want_a_budget_of_steps(tmp_path):
    with pytest.raises(SystemExit, match="--steps"):
        main(Args(data=tmp_path, seconds=1.0, kills=2))
