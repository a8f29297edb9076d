"""Runs in processes of their own: what is reused, what is refused, what a failure leaves.

The worker here is a script that makes runs up; tests/cli/test_compare_real.py trains.
"""

import dataclasses
import json
from io import StringIO

import pytest
from rich.console import Console

from abcd_ns.errors import UserError
from abcd_ns.lab.compare.command import carry_out, without_impossible
from abcd_ns.lab.compare.protocol import Options, Plan, make_plan
from abcd_ns.lab.compare.results import read_results
from abcd_ns.lab.runs import runner
from abcd_ns.lab.runs.records import encode
from abcd_ns.lab.runs.run import Failure, Run
from abcd_ns.lab.runs.runner import claim, last_line, run_jobs
from tests.lab.compare.fake_worker import FakeWorker
from tests.lab.compare.records import MACHINE


@pytest.fixture
def worker(tmp_path, monkeypatch) -> FakeWorker:
    monkeypatch.setattr(runner, "POLL_SECONDS", 0.01)
    return FakeWorker(tmp_path / "worker")


@pytest.fixture
def plan(tmp_path) -> Plan:
    scene = tmp_path / "scene"
    scene.mkdir()
    out = tmp_path / "out"
    return make_plan(Options(data=str(scene), out=str(out), steps=10, methods=("abcd-monolithic", "abcd")))


def run(plan: Plan, worker: FakeWorker) -> list[Run | Failure]:
    claim(plan.out, plan, MACHINE, overwrite=False)
    return run_jobs(plan, Console(file=StringIO()), worker.command)


def test_finished_runs_are_reused(plan, worker):
    first = run(plan, worker)
    assert [outcome.method for outcome in first] == worker.calls() == ["abcd-monolithic", "abcd"]
    assert run(plan, worker) == first
    assert worker.calls() == []


def test_an_interrupted_comparison_goes_on_where_it_was(plan, worker):
    run(dataclasses.replace(plan, methods=("abcd-monolithic",)), worker)
    half = plan.jobs[1].folder(plan.out)  # what a killed worker leaves
    half.mkdir(parents=True)
    (half / "job.json").write_text(json.dumps(encode(plan.jobs[1])))
    (half / "leftover").write_text("")
    worker.calls()
    assert [outcome.method for outcome in run(plan, worker)] == ["abcd-monolithic", "abcd"]
    assert worker.calls() == ["abcd"]
    assert not (half / "leftover").exists()


def test_a_spoilt_run_is_run_again(plan, worker):
    run(plan, worker)
    worker.calls()
    (plan.jobs[0].folder(plan.out) / "run.json").write_text('{"psnr": NaN}')
    run(plan, worker)
    assert worker.calls() == ["abcd-monolithic"]


@pytest.mark.parametrize(
    ("behaviour", "reason"),
    [
        ("raises", "ValueError: the scene is empty"),
        ("is killed", "ended by SIGKILL (out of memory?)"),
        ("is silent", "starting"),
    ],
)
def test_a_failed_run_is_reported_and_the_others_go_on(plan, worker, behaviour, reason):
    worker.behave(abcd_monolithic=behaviour)
    failure, finished = run(plan, worker)
    assert isinstance(failure, Failure)
    assert (failure.method, failure.reason) == ("abcd-monolithic", reason)
    assert (plan.out / failure.log).read_text().startswith("starting")
    assert isinstance(finished, Run)
    worker.behave()
    assert [type(outcome) for outcome in run(plan, worker)] == [Run, Run]


def test_a_comparison_with_a_failure_still_writes_everything(plan, worker, monkeypatch):
    worker.behave(abcd="raises")
    monkeypatch.setattr("abcd_ns.lab.compare.command.run_jobs", lambda p, c: run_jobs(p, c, worker.command))
    stream = StringIO()
    assert carry_out(plan, Console(file=stream, width=100)) == 1
    results = read_results(plan.out / "results.json")
    assert [found.method for found in results.runs] == ["abcd-monolithic"]
    assert [failure.method for failure in results.failures] == ["abcd"]
    for name in ("table.md", "speed_accuracy.png", "speed_accuracy.svg"):
        assert (plan.out / name).stat().st_size > 0
    assert "ValueError: the scene is empty" in (plan.out / "table.md").read_text()
    assert "PSNR" in stream.getvalue()


def test_nothing_but_failures_is_reported_too(plan, worker, monkeypatch):
    worker.behave(abcd="raises", abcd_monolithic="raises")
    monkeypatch.setattr("abcd_ns.lab.compare.command.run_jobs", lambda p, c: run_jobs(p, c, worker.command))
    assert carry_out(plan, Console(file=StringIO())) == 1
    assert len(read_results(plan.out / "results.json").failures) == 2
    assert not (plan.out / "speed_accuracy.png").exists()


@pytest.mark.parametrize(
    ("field", "value"),
    [("steps", 11), ("blocks", 2), ("downscale", 2), ("densify", False), ("data", "other")],
)
def test_another_protocol_is_refused_by_name(plan, worker, field, value):
    run(plan, worker)
    other = dataclasses.replace(plan, settings=dataclasses.replace(plan.settings, **{field: value}))
    with pytest.raises(UserError, match=rf"holds runs with {field} .*, not {value}") as caught:
        claim(plan.out, other, MACHINE, overwrite=False)
    assert "\n" not in str(caught.value)


def test_runs_of_another_machine_are_refused(plan, worker):
    run(plan, worker)
    with pytest.raises(UserError, match="holds runs with cores 2, not 64"):
        claim(plan.out, plan, dataclasses.replace(MACHINE, cores=64), overwrite=False)


def test_overwrite_drops_the_runs(plan, worker):
    run(plan, worker)
    worker.calls()
    other = dataclasses.replace(plan, settings=dataclasses.replace(plan.settings, steps=11))
    claim(plan.out, other, MACHINE, overwrite=True)
    run(other, worker)
    assert worker.calls() == ["abcd-monolithic", "abcd"]


def test_more_seeds_and_methods_may_join(plan, worker):
    run(plan, worker)
    worker.calls()
    run(dataclasses.replace(plan, seeds=(0, 1)), worker)
    assert worker.calls() == ["abcd-monolithic", "abcd"]


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_folder_of_something_else_is_left_alone(plan, overwrite):
    plan.out.mkdir()
    (plan.out / "thesis.tex").write_text("mine")
    with pytest.raises(UserError, match="is not empty and holds no comparison"):
        claim(plan.out, plan, MACHINE, overwrite)
    assert [path.name for path in plan.out.iterdir()] == ["thesis.tex"]


def test_a_file_is_no_folder(plan):
    plan.out.write_text("")
    with pytest.raises(UserError, match="is a file"):
        claim(plan.out, plan, MACHINE, overwrite=False)


def test_splatfacto_is_left_out_with_a_reason_where_it_cannot_run(plan, monkeypatch):
    wanted = dataclasses.replace(plan, methods=("abcd", "splatfacto"))
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    reduced, (left,) = without_impossible(wanted)
    assert reduced.methods == ("abcd",)
    assert (left.method, "CUDA" in left.reason) == ("splatfacto", True)
    assert without_impossible(plan) == (plan, ())
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    assert without_impossible(wanted) == (wanted, ())
    limited = dataclasses.replace(wanted, settings=dataclasses.replace(wanted.settings, max_gaussians=9))
    assert without_impossible(limited)[0].methods == ("abcd",)


@pytest.mark.parametrize(
    ("content", "expected"),
    [(b"", ""), (b"\n \n", ""), (b"a\nb\n\n", "b"), (b"10%\r20%\r", "20%"), (b"\xff\n", "\ufffd")],
)
def test_last_line_of_a_log(tmp_path, content, expected):
    (tmp_path / "log").write_bytes(content)
    assert last_line(tmp_path / "log") == expected
