"""`abcd stability`: what it refuses, what it writes, and that it hides no failure."""

import io
from dataclasses import replace

import pytest
from rich.console import Console
from rich.progress import Progress

from abcd_ns.cli import main as cli
from abcd_ns.errors import UserError
from abcd_ns.lab.results.findings import headline
from abcd_ns.lab.results.records import read_json
from abcd_ns.lab.results.results import Curve, Line, Outcome, Results
from abcd_ns.lab.runs.experiment import write_report
from abcd_ns.lab.stability import command
from abcd_ns.lab.stability.charts import draw_curves
from abcd_ns.lab.stability.command import KIND, SCENARIOS, carry_out, choose
from abcd_ns.lab.stability.curves import studies
from abcd_ns.lab.stability.lab import Lab
from abcd_ns.lab.stability.outcome import Finding, Scenario, against_one_block
from tests.lab.compare.records import made_up, read_results

GOOD = Outcome(
    "A1", "NaN | in splats", "NaN put in", "mended", True, False, {"abcd": "fine"}, {"lost": 0.1}, 2.0
)
BAD = replace(GOOD, id="A2", passed=False, worse=True)
CURVE = Curve(
    "blocks",
    "number of blocks",
    "blocks",
    (Line("abcd", (2.0, 8.0), (25.0, 24.5)), Line("abcd-ablated", (2.0, 8.0), (20.0, 15.0))),
    level=25.5,
)


@pytest.fixture
def report() -> Results:
    return made_up(KIND, settings=None, outcomes=(GOOD, BAD), curves=(CURVE,))


def test_what_is_written_is_read_back(report, tmp_path):
    paths = write_report(report, tmp_path, draw_curves)
    assert {path.name for path in paths} == {"results.json", "table.md", "blocks.png"}
    assert read_results(tmp_path / "results.json") == report


def test_failures_and_losses_to_one_block_are_said(report, tmp_path):
    write_report(report, tmp_path, draw_curves)
    text = (tmp_path / "table.md").read_text()
    assert "1 of 2 scenarios pass; these fail: A2; one block does better, by however little, in A2." in text
    assert "**fail**, one block is better" in text
    assert "NaN \\| in splats" in text
    assert "| abcd-ablated | 20.00 | 15.00 |" in text
    assert "| one block | 25.50 | 25.50 |" in text
    assert headline([GOOD]) == "1 of 1 scenarios pass."


def test_charts_name_every_method_and_the_level(report, tmp_path, drawn):
    draw_curves(report, tmp_path)
    wanted = {"abcd-ablated", "abcd-monolithic  25.50", "number of blocks"}
    assert wanted <= set(drawn["blocks.png"])


@pytest.mark.parametrize(
    ("behind", "passed", "worse"), [(-1.0, True, False), (0.2, True, True), (0.4, False, True)]
)
def test_the_rule_against_one_block(behind, passed, worse):
    found = against_one_block({"abcd": 20.0, "abcd-monolithic": 20.0 + behind})
    assert (found.passed, found.worse) == (passed, worse)


def test_only_known_scenarios_are_chosen():
    assert [scenario.id for scenario in choose(["A21", "A7"], SCENARIOS)] == ["A7", "A21"]
    assert len(choose([], SCENARIOS)) == 22
    with pytest.raises(UserError, match="--only A99: there is no such scenario; there are A1,"):
        choose(["A99"], SCENARIOS)
    with pytest.raises(UserError, match="R1 to R5 need --data"):
        choose(["R1"], SCENARIOS)


def test_a_folder_of_something_else_is_refused(tmp_path, capsys):
    (tmp_path / "thesis.tex").touch()
    assert cli.main(["stability", "--out", str(tmp_path), "--only", "A7"]) == 2
    assert "is not empty and holds no stability report" in " ".join(capsys.readouterr().err.split())


def test_what_is_done_is_kept_when_the_rest_breaks_off(tmp_path):
    def stop(_):
        raise KeyboardInterrupt

    good = Scenario("A1", "fails", "done", "rule", lambda _: Finding(True, {"abcd": "fine"}))
    rest, kept = replace(good, id="A2", run=stop), []
    console = Console(file=io.StringIO())
    progress = Progress(console=console)
    with pytest.raises(KeyboardInterrupt):
        carry_out(Lab(tmp_path), [good, rest], [], progress, lambda outcomes, _: kept.append(list(outcomes)))
    assert [[outcome.id for outcome in outcomes] for outcomes in kept] == [["A1"]]
    assert "A1  pass  fails" in console.file.getvalue()


def test_every_curve_has_its_points():
    assert {study.name for study in studies()} == {
        "blocks",
        "visit-steps",
        "staleness",
        "views",
        "pose-noise",
        "exposure",
    }
    assert all(len(study) >= 2 for study in studies())


def test_the_command_writes_a_report(tmp_path, capsys):
    code = cli.main(["stability", "--out", str(tmp_path / "out"), "--only", "A7", "A21"])
    printed = capsys.readouterr().out
    assert code == 0, printed
    report = read_results(tmp_path / "out" / "results.json")
    assert [outcome.id for outcome in report.outcomes] == ["A7", "A21"]
    assert "2 of 2 scenarios pass." in printed
    assert report.command == "abcd stability --only A21 A7 --seed 0 --out out"
    before = (tmp_path / "out" / "results.json").read_bytes()
    assert cli.main(["stability", "--out", str(tmp_path / "out"), "--only", "A7"]) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert (tmp_path / "out" / "results.json").read_bytes() == before


@pytest.mark.parametrize("wrong", [["--only", "Z9"], ["--data", "nothing"]])
def test_what_is_refused_takes_no_folder(tmp_path, wrong):
    out = tmp_path / "out"
    assert cli.main(["stability", "--out", str(out), *wrong]) == 2
    assert not out.exists()


def test_scenarios_are_recorded_by_their_ids_however_they_are_written(tmp_path, monkeypatch):
    carried = []
    monkeypatch.setattr(command, "carry_out", lambda _, chosen, *__: carried.append(chosen) or [GOOD])
    for only in (["a7", "A21", "A7"], ["A21", "A7"]):  # the second is no other experiment than the first
        assert cli.main(["stability", "--out", str(tmp_path / "out"), "--only", *only]) == 0
    assert [[scenario.id for scenario in chosen] for chosen in carried] == [["A7", "A21"]] * 2
    marker = read_json(tmp_path / "out" / f"{KIND.replace(' ', '-')}.json")
    assert marker["scenarios"]["only"] == ["A21", "A7"]


def test_a_seed_below_0_is_refused(tmp_path, capsys):
    assert cli.main(["stability", "--out", str(tmp_path / "out"), "--only", "A7", "--seed", "-1"]) == 2
    assert "--seed is -1; it must be at least 0." in " ".join(capsys.readouterr().err.split())
