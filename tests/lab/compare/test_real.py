"""One comparison that really trains, on a scene of a few dozen pixels."""

import json
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from abcd_ns.cli.export import export
from abcd_ns.lab.compare.command import Options, carry_out, make_plan
from abcd_ns.lab.results.results import CurvePoint
from tests.lab.compare.records import read_results
from tests.lab.in_process import jobs_in_this_process
from tests.reference.colmap_scene import HELD_OUT, write_scene

METHODS = "abcd-monolithic", "abcd", "splatfacto-scaled"
STEPS = 20


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """(results, plan, what was printed) of methods, really trained, the first in a process of its own."""
    folder = tmp_path_factory.mktemp("compare")
    write_scene(folder / "scene")
    given = {"methods": METHODS, "steps": STEPS, "blocks": (2,), "evals": 3, "pictures": 1}
    options = Options(data=str(folder / "scene"), out=str(folder / "out"), **given)
    plan, stream = make_plan(options), StringIO()
    with pytest.MonkeyPatch.context() as patch:
        jobs_in_this_process(patch, first_is_real=True)
        code = carry_out(plan, Console(file=stream, width=100))
    assert code == 0, stream.getvalue()
    return read_results(plan.out / "results.json"), plan, stream.getvalue()


@pytest.mark.cli
def test_a_scene_is_as_large_as_its_export(compared, tmp_path):
    results, plan, _ = compared
    for run in results.runs[:2]:
        for suffix, size in {".ply": run.ply_bytes, ".spz": run.spz_bytes}.items():
            out = tmp_path / f"{run.method}{suffix}"
            export(plan.out / "runs" / run.method / "seed-0", out=out, frame="nerfstudio")
            assert size == out.stat().st_size


@pytest.mark.cli
def test_runs_report_what_was_asked_for(compared):
    results, _, printed = compared
    assert tuple(run.method for run in results.runs) == METHODS
    for run in results.runs:
        assert run.steps == STEPS
        assert len(run.views) == HELD_OUT
        assert [view.name for view in run.views] == ["00.png", "08.png"]
        assert run.psnr == pytest.approx(sum(view.psnr for view in run.views) / HELD_OUT)
        assert run.psnr > 12
        assert run.gaussians > 0
        assert 0 < run.train_seconds < run.total_seconds
        assert run.peak_rss_bytes > 100 << 20
        assert run.method in printed
    single, blocks, peer = results.runs
    assert peer.blocks == 1
    assert min(single.store_bytes, blocks.store_bytes) > 0
    assert (single.blocks, blocks.blocks) == (1, 2)
    assert single.ordering_gap_note
    assert single.layer_seconds < blocks.layer_seconds < blocks.train_seconds
    assert single.psnr == pytest.approx(single.psnr_merged, abs=1e-4)
    # By fragments, composited is merged to rounding.
    assert blocks.ordering_gap_db is None or blocks.ordering_gap_db > 80
    assert blocks.psnr == pytest.approx(blocks.psnr_merged, abs=1e-2)


@pytest.mark.cli
def test_curves_rise_in_time_to_the_final_score_as_in_logs_of_abcd(compared):
    results, plan, _ = compared
    for job, run in zip(plan.jobs, results.runs, strict=True):
        seconds = [point.seconds for point in run.curve]
        assert seconds == sorted(seconds)
        assert [point.steps for point in run.curve] == [np.ceil(s * STEPS) for s in plan.settings.moments]
        assert all(point.gaussians > 0 for point in run.curve)
        end = CurvePoint(run.train_seconds, STEPS, run.psnr_merged, run.gaussians)
        assert run.curve[-1] == end
        if run.method == "splatfacto-scaled":
            continue
        lines = map(json.loads, (job.folder(plan.out) / "abcd" / "log.jsonl").read_text().splitlines())
        scores = [line["psnr"] for line in lines if line["kind"] == "held out"]
        assert scores == [point.psnr for point in run.curve[:-1]]


@pytest.mark.cli
def test_reports_are_there_and_name_no_folder_of_this_machine(compared):
    _, plan, _ = compared
    assert [path.name for path in (plan.out / "pictures").iterdir()] == ["view-0001.png"]
    for name in ("table.md", "speed_accuracy.png", "size_accuracy.png", "memory.png"):
        assert (plan.out / name).stat().st_size > 0
    text = (plan.out / "results.json").read_text()
    assert str(plan.out.parent) not in text
    assert f"{Path.home()}/" not in text
