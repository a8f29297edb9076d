"""results.json: what is written comes back, and what does not fit is refused by name."""

import dataclasses
import json
import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from abcd_ns.lab.results.records import RecordError, decode, encode, write_json
from abcd_ns.lab.results.results import SCHEMA
from abcd_ns.lab.results.run import CurvePoint, Run
from abcd_ns.lab.runs.evaluate import ordering_gap
from tests.lab.compare.records import made_up_results, made_up_run, read_results

RUN = ("arms", 0, "runs", 0)
finite = st.floats(allow_nan=False, allow_infinity=False, width=32)


@given(
    psnr=finite,
    gap=st.none() | finite,
    gaussians=st.integers(0, 2**40),
    curve=st.lists(st.tuples(finite, st.integers(0, 10**9), finite), min_size=1, max_size=4),
    reason=st.none() | st.text(max_size=20),
)
def test_results_come_back_as_they_were_written(tmp_path_factory, psnr, gap, gaussians, curve, reason):
    path = tmp_path_factory.mktemp("results") / "results.json"
    points = tuple(CurvePoint(*point) for point in curve)
    fields = {"ordering_gap_db": gap, "gaussians": gaussians, "curve": points, "lpips_reason": reason}
    results = made_up_results(made_up_run(**fields), made_up_run("abcd-monolithic", psnr=psnr))

    write_json(path, encode(results))

    assert read_results(path) == results


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_no_number_that_json_lacks_is_written(tmp_path, number):
    bad = made_up_run(curve=(CurvePoint(1.0, 1, 20.0), CurvePoint(2.0, 2, number)))
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(tmp_path / "results.json", encode(made_up_results(made_up_run(), bad)))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("constant", ["NaN", "Infinity", "-Infinity"])
def test_no_number_that_json_lacks_is_read(tmp_path, constant):
    path = tmp_path / "results.json"
    write_json(path, encode(made_up_results(made_up_run(ssim=0.875))))
    path.write_text(path.read_text().replace("0.875", constant))
    with pytest.raises(RecordError, match="is not JSON"):
        read_results(path)


def spoil(data: dict, *steps, value=None, drop=False) -> dict:
    """`data` with the value at `steps` replaced or dropped."""
    *way, last = steps
    place = data
    for step in way:
        place = place[step]
    if drop:
        del place[last]
    else:
        place[last] = value
    return data


@pytest.mark.parametrize(
    ("steps", "change", "message"),
    [
        (("schema",), {"value": SCHEMA + 1}, f"has schema {SCHEMA + 1}"),
        ((*RUN, "psnr"), {"value": "24"}, r"Expected float, got str - at arms\[0\]\.runs\[0\]\.psnr"),
        ((*RUN, "psnr"), {"value": None}, "Expected float, got null"),
        ((*RUN, "steps"), {"value": 1.5}, "Expected int, got float"),
        ((*RUN, "steps"), {"value": True}, "Expected int, got bool"),
        ((*RUN, "curve"), {"value": 3}, "Expected array, got int"),
        ((*RUN, "method"), {"drop": True}, "missing required field method"),
        (("amrs",), {"value": []}, "unknown field 'amrs'; did you mean 'arms'"),
        (("machine",), {"value": []}, "Expected object, got array - at machine"),
        (("settings", "densify"), {"value": 1}, "Expected bool, got int - at settings.densify"),
    ],
)
def test_a_file_that_does_not_fit_is_refused_by_field(tmp_path, steps, change, message):
    path = tmp_path / "results.json"
    data = json.loads(json.dumps(encode(made_up_results(made_up_run()))))
    path.write_text(json.dumps(spoil(data, *steps, **change)))
    with pytest.raises(RecordError, match=message) as caught:
        read_results(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_what_the_documents_rest_on_is_still_read():
    stored = (Path(__file__).resolve().parents[3] / "docs" / "results").rglob("*.json")
    paths = [path for path in stored if json.loads(path.read_text()).get("schema") == SCHEMA]
    assert all(read_results(path).command.startswith("abcd ") for path in paths)
    assert "stability" in {path.parent.name for path in paths}


@pytest.mark.parametrize("content", ["", "{", "[]", "3"])
def test_what_is_no_results_file_is_refused(tmp_path, content):
    path = tmp_path / "results.json"
    path.write_text(content)
    with pytest.raises(RecordError, match=r"results\.json"):
        read_results(path)


def test_every_field_of_a_run_is_required():
    """But for those that came later: older results are read."""
    data = encode(made_up_run())
    required = [field for field in dataclasses.fields(Run) if field.default is dataclasses.MISSING]
    assert len(required) > 10
    for field in required:
        with pytest.raises(RecordError, match=f"missing required field {field.name}"):
            decode(Run, {name: value for name, value in data.items() if name != field.name}, "run.json")


@given(st.lists(st.floats(1e-12, 1.0), min_size=1, max_size=6))
def test_ordering_gap_is_the_psnr_of_the_mean_squared_difference(squared):
    gap, note = ordering_gap(squared, blocks=2)
    assert note is None
    assert 10 ** (-gap / 10) == pytest.approx(sum(squared) / len(squared))


@pytest.mark.parametrize(("squared", "blocks"), [([1e-3], 1), ([0.0, 0.0], 4)])
def test_no_ordering_gap_has_a_reason(squared, blocks):
    gap, note = ordering_gap(squared, blocks)
    assert gap is None
    assert note
