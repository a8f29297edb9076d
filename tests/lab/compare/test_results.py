"""results.json: what is written comes back, and what does not fit is refused by name."""

import json
import math
from dataclasses import asdict
from pathlib import Path

import pytest

from abcd_ns.lab.results.records import RecordError, write_json
from abcd_ns.lab.results.results import SCHEMA, CurvePoint
from abcd_ns.lab.runs.evaluate import ordering_gap
from tests.lab.compare.records import made_up_results, made_up_run, read_results


def test_results_come_back_as_they_were_written(tmp_path):
    points = (CurvePoint(0.1, 10**9, -3.5, 7), CurvePoint(1e9, 2, 1e-30))
    run = made_up_run(ordering_gap_db=None, gaussians=2**40, curve=points, lpips_reason="\ud7ff \u2713 'a'")
    results = made_up_results(run, made_up_run("abcd-monolithic"))
    write_json(tmp_path / "results.json", asdict(results))
    assert read_results(tmp_path / "results.json") == results


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_no_number_that_json_lacks_is_written_or_read(tmp_path, number):
    path = tmp_path / "results.json"
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(path, asdict(made_up_results(made_up_run(ssim=number))))
    assert not path.exists()
    path.write_text(json.dumps(asdict(made_up_results(made_up_run(ssim=number)))))
    with pytest.raises(RecordError, match="is not JSON"):
        read_results(path)


@pytest.mark.parametrize(
    ("was", "becomes", "message"),
    [
        ('"schema": 2', '"schema": 3', "has schema 3"),
        ('"psnr": 23.5', '"psnr": "24"', r"Expected float, got str - at arms\[0\]\.runs\[0\]\.psnr"),
        ('"steps": 600, ', "", "missing required field steps"),
        ('"arms": [', '"amrs": [', "unknown field 'amrs'; did you mean 'arms'"),
        ("{", "", r"results\.json is not JSON"),
    ],
)
def test_a_file_that_does_not_fit_is_refused_by_field(tmp_path, was, becomes, message):
    path, text = tmp_path / "results.json", json.dumps(asdict(made_up_results(made_up_run(psnr=23.6))))
    assert was in text
    path.write_text(text.replace(was, becomes, 1))
    with pytest.raises(RecordError, match=message) as caught:
        read_results(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_what_the_documents_rest_on_is_still_read():
    stored = (Path(__file__).resolve().parents[3] / "docs" / "results").rglob("*.json")
    paths = [path for path in stored if json.loads(path.read_text()).get("schema") == SCHEMA]
    assert all(read_results(path).command.startswith("abcd ") for path in paths)
    assert "stability" in {path.parent.name for path in paths}


def test_the_ordering_gap_is_the_psnr_of_the_mean_squared_difference_or_has_a_reason():
    assert ordering_gap([1e-3, 3e-3], blocks=2) == (pytest.approx(26.9897), None)
    for squared, blocks in (([1e-3], 1), ([0.0, 0.0], 4)):
        gap, note = ordering_gap(squared, blocks)
        assert gap is None
        assert note
