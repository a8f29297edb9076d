"""Runs in processes of their own: what is reused, what is refused, what a failure leaves.

The worker here is a script that makes runs up; test_real.py trains.
"""

import dataclasses
import json
import subprocess
import sys
from io import StringIO

import psutil
import pytest
from rich.console import Console

from abcd_ns.cli import main as cli
from abcd_ns.errors import UserError
from abcd_ns.lab.compare.command import Options, carry_out, make_plan
from abcd_ns.lab.job import Plan
from abcd_ns.lab.results.results import Failure, Run
from abcd_ns.lab.runs.runner import run_jobs
from tests.lab.compare.records import MACHINE, read_results


@pytest.fixture
def plan(tmp_path) -> Plan:
    methods = ("abcd-monolithic", "abcd")
    return make_plan(Options(data=str(tmp_path), out=str(tmp_path / "out"), steps=10, methods=methods))


def run(plan: Plan, overwrite: bool = False) -> list[Run | Failure]:
    *_, results = run_jobs(plan, Console(file=StringIO()), overwrite)
    found = {(one.method, one.seed): one for one in (*results.runs, *results.failures)}
    return [found[job.method, job.seed] for job in plan.jobs]


def test_finished_runs_are_reused_and_others_are_not(plan, worker):
    first = run(plan)
    assert [outcome.method for outcome in first] == worker.calls() == ["abcd-monolithic", "abcd"]
    assert run(plan) == first
    assert worker.calls() == []
    spoilt, half = (job.folder(plan.out) for job in plan.jobs)
    (spoilt / "run.json").write_text('{"psnr": NaN}')
    (half / "run.json").rename(half / "leftover")  # as if its worker had been killed
    assert run(plan) == first
    assert worker.calls() == ["abcd-monolithic", "abcd"]
    assert not (half / "leftover").exists()


JOB = """
import os, time
from abcd_ns.lab.job import Job
from abcd_ns.lab.runs.runner import work
work(Job, lambda *_: (print(os.getpid(), flush=True), time.sleep(60)))
"""
PARENT = "import subprocess, sys; subprocess.run([sys.executable, *sys.argv[1:]])"


@pytest.mark.skipif(sys.platform != "linux", reason="asks Linux")
def test_a_job_ends_with_a_comparison_that_is_killed(plan, tmp_path):
    job = tmp_path / "job.json"
    job.write_text(json.dumps(dataclasses.asdict(plan.jobs[0])))
    command = [sys.executable, "-c", PARENT, "-c", JOB, str(job)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as parent:
        child = psutil.Process(int(parent.stdout.readline()))
        parent.terminate()
        child.wait(10)


@pytest.mark.parametrize(
    ("behaviour", "reason"),
    [
        ("raises", "ValueError: the scene is empty"),
        ("is killed", "ended by SIGKILL (out of memory?)"),
        ("is silent", "starting"),
    ],
)
def test_a_failed_run_is_reported_and_the_others_go_on(plan, worker, behaviour, reason):
    worker.behave({"abcd-monolithic": behaviour})
    failure, finished = run(plan)
    assert isinstance(failure, Failure)
    assert (failure.method, failure.reason) == ("abcd-monolithic", reason)
    assert (plan.out / failure.log).read_text().startswith("starting")
    assert isinstance(finished, Run)
    worker.behave({})
    assert [type(outcome) for outcome in run(plan)] == [Run, Run]


def test_another_protocol_or_machine_is_refused_by_name_until_overwritten(plan, worker, monkeypatch):
    run(plan)
    worker.calls()
    for field, value in (("steps", 11), ("blocks", 2), ("data", "other")):
        settings = dataclasses.replace(plan.settings, **{field: value})
        jobs = tuple(dataclasses.replace(job, settings=settings) for job in plan.jobs)
        other = dataclasses.replace(plan, settings=settings, jobs=jobs)
        with pytest.raises(UserError, match=rf"holds runs with {field} .*, not {value}"):
            run(other)
    assert worker.calls() == []
    run(other, overwrite=True)
    assert worker.calls() == ["abcd-monolithic", "abcd"]
    larger = dataclasses.replace(MACHINE, cores=64)
    monkeypatch.setattr("abcd_ns.lab.runs.runner.describe_machine", lambda: larger)
    with pytest.raises(UserError, match="holds runs with cores 2, not 64"):
        run(other)


@pytest.mark.usefixtures("worker")
def test_photos_and_points_that_changed_are_refused(plan):
    for scene in ("12 views", None, "12 views"):  # older folders do not say
        run(dataclasses.replace(plan, scene=scene))
    with pytest.raises(UserError, match="holds runs with photos and points 12 views, not 11 views"):
        run(dataclasses.replace(plan, scene="11 views"))


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_folder_of_something_else_is_left_alone(plan, overwrite):
    plan.out.mkdir()
    (plan.out / "thesis.tex").write_text("mine")
    with pytest.raises(UserError, match="is not empty and holds no comparison"):
        run(plan, overwrite)
    assert [path.name for path in plan.out.iterdir()] == ["thesis.tex"]


def test_a_scene_that_cannot_be_read_is_refused_before_the_first_run(plan, worker, capsys):
    words = ["compare", "--data", plan.settings.data, "--out", str(plan.out), "--steps", "10"]
    assert cli.main(words) == 2
    assert "holds no model" in " ".join(capsys.readouterr().err.split())
    assert not plan.out.exists()
    assert worker.calls() == []


def test_a_change_that_failed_is_named_and_all_is_written(plan, worker):
    worker.behave({"training.batch=1": "raises"})
    options = Options(data=plan.settings.data, out=str(plan.out), steps=10)
    varied = make_plan(dataclasses.replace(options, vary=("training.batch=1", "training.warmup=0")))
    stream = StringIO()
    assert carry_out(varied, Console(file=stream, width=100)) == 1
    assert "PSNR" in stream.getvalue()
    assert worker.calls() == ["abcd", "abcd training.batch=1", "abcd training.warmup=0"]
    results = read_results(plan.out / "results.json")
    assert [arm.variant for arm in results.arms] == ["default", "training.warmup=0"]
    assert [failure.variant for failure in results.failures] == ["training.batch=1"]
    text = (plan.out / "table.md").read_text()
    assert "abcd, training.batch=1, seed 0 failed" in text
    assert "ValueError: the scene is empty" in text
    for name in ("speed_accuracy.png", "memory.png"):
        assert (plan.out / name).stat().st_size > 0
