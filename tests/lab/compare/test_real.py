"""One comparison that really trains, on a scene of a few dozen pixels."""

import json
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from abcd_ns.cli.export.command import export
from abcd_ns.lab.compare.command import Options, carry_out, make_plan
from tests.lab.compare.records import read_results
from tests.lab.in_process import jobs_in_this_process
from tests.reference.colmap_scene import HELD_OUT, write_scene

STEPS = 20


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """(results, plan, what was printed) of two methods, really trained, the first in a process of its own."""
    folder = tmp_path_factory.mktemp("compare")
    write_scene(folder / "scene")
    options = Options(
        data=str(folder / "scene"),
        out=str(folder / "out"),
        methods=("abcd-monolithic", "abcd"),
        steps=STEPS,
        blocks=(2,),
        evals=3,
        pictures=1,
    )
    plan, stream = make_plan(options), StringIO()
    with pytest.MonkeyPatch.context() as patch:
        jobs_in_this_process(patch, first_is_real=True)
        code = carry_out(plan, Console(file=stream, width=100))
    assert code == 0, stream.getvalue()
    return read_results(plan.out / "results.json"), plan, stream.getvalue()


@pytest.mark.cli
def test_a_scene_is_as_large_as_its_export(compared, tmp_path):
    results, plan, _ = compared
    for run in results.runs:
        for suffix, size in {".ply": run.ply_bytes, ".spz": run.spz_bytes}.items():
            out = tmp_path / f"{run.method}{suffix}"
            export(plan.out / "runs" / run.method / "seed-0", out=out, frame="nerfstudio")
            assert size == out.stat().st_size


@pytest.mark.cli
def test_runs_report_what_was_asked_for(compared):
    results, _, printed = compared
    assert [run.method for run in results.runs] == ["abcd-monolithic", "abcd"]
    for run in results.runs:
        assert run.steps == STEPS
        assert len(run.views) == HELD_OUT
        assert [view.name for view in run.views] == ["00.png", "08.png"]
        assert run.psnr == pytest.approx(sum(view.psnr for view in run.views) / HELD_OUT)
        assert run.psnr > 12
        assert run.gaussians > 0
        assert 0 < run.train_seconds < run.total_seconds
        assert run.peak_rss_bytes > 100 << 20
        assert run.store_bytes > 0
        assert run.method in printed


@pytest.mark.cli
def test_a_runs_log_has_the_curve_for_its_report(compared):
    results, plan, _ = compared
    for job, run in zip(plan.jobs, results.runs, strict=True):
        lines = map(json.loads, (job.folder(plan.out) / "abcd" / "log.jsonl").read_text().splitlines())
        scores = [line["psnr"] for line in lines if line["kind"] == "held out"]
        assert scores == [point.psnr for point in run.curve[:-1]]
        assert len(scores) == 2


@pytest.mark.cli
def test_curves_rise_in_time_to_the_final_score(compared):
    results, plan, _ = compared
    for run in results.runs:
        seconds, steps = ([getattr(p, name) for p in run.curve] for name in ("seconds", "steps"))
        assert len(run.curve) == plan.settings.evals
        assert seconds == sorted(seconds)
        assert steps == sorted(set(steps))
        assert run.curve[-1].psnr == run.psnr_merged
        assert (seconds[-1], steps[-1]) == (run.train_seconds, STEPS)
        assert run.curve[-1].gaussians == run.gaussians
        assert all(point.gaussians > 0 for point in run.curve)
        for share, point in zip(plan.settings.moments, run.curve, strict=True):
            assert point.steps == int(np.ceil(share * STEPS))


@pytest.mark.cli
def test_blocks_and_layers_are_accounted_for(compared):
    single, blocks = compared[0].runs
    assert (single.blocks, blocks.blocks) == (1, 2)
    assert single.ordering_gap_db is None
    assert single.ordering_gap_note
    assert single.layer_seconds < blocks.layer_seconds < blocks.train_seconds
    assert single.psnr == pytest.approx(single.psnr_merged, abs=1e-4)
    # By fragments, composited is merged to rounding.
    assert blocks.ordering_gap_db is None or blocks.ordering_gap_db > 80
    assert blocks.psnr == pytest.approx(blocks.psnr_merged, abs=1e-2)


@pytest.mark.cli
def test_reports_are_there_and_a_second_call_trains_nothing(compared):
    results, plan, _ = compared
    pictures = [path.name for path in (plan.out / "pictures").iterdir()]
    assert pictures == ["view-0001.png"]
    for name in ("table.md", "speed_accuracy.png", "size_accuracy.png", "memory.png"):
        assert (plan.out / name).stat().st_size > 0
    stream = StringIO()
    assert carry_out(plan, Console(file=stream, width=100)) == 0
    assert stream.getvalue().count("reused") == 2
    assert read_results(plan.out / "results.json").runs == results.runs
    text = (plan.out / "results.json").read_text()  # it names no folder of this machine
    assert str(plan.out.parent) not in text
    assert f"{Path.home()}/" not in text
