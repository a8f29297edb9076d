"""`abcd stability`: what it refuses, what it writes, and that it hides no failure."""

from dataclasses import replace

import pytest

from abcd_ns.cli import main as cli
from abcd_ns.errors import UserError
from abcd_ns.lab.results.results import Outcome
from abcd_ns.lab.results.tables import headline
from abcd_ns.lab.runs.runner import write_report
from abcd_ns.lab.stability import command
from abcd_ns.lab.stability.command import KIND, SCENARIOS, choose
from abcd_ns.lab.stability.lab import Finding, Scenario
from tests.lab.compare.records import made_up, read_results

GOOD = Outcome(
    "A3", "NaN | in splats", "NaN put in", "mended", True, False, {"abcd": "fine"}, {"lost": 0.1}, 2.0
)
BAD = replace(GOOD, id="A5", passed=False, worse=True)
FINE = Scenario("A3", "fails", "done", "rule", lambda _: Finding(True, {"abcd": "fine"}))


def test_failures_and_losses_to_one_block_are_said_and_read_back(tmp_path):
    report = made_up(KIND, settings=None, outcomes=(GOOD, BAD))
    write_report(report, tmp_path)
    assert read_results(tmp_path / "results.json") == report
    text = (tmp_path / "table.md").read_text()
    assert "1 of 2 scenarios pass; these fail: A5; one block does better, by however little, in A5." in text
    assert "**fail**, one block is better" in text
    assert "NaN \\| in splats" in text
    assert headline([GOOD]) == "1 of 1 scenarios pass."


def test_only_known_scenarios_are_chosen(tmp_path):
    assert [scenario.id for scenario in choose(["A14", "A11"])] == ["A11", "A14"]
    assert [scenario.id for scenario in choose([])] == list(SCENARIOS)
    with pytest.raises(UserError, match="--only A99: there is no such scenario; there are A11,"):
        choose(["A99"])
    for wrong in (["--only", "Z9"], ["--seed", "-1"]):
        assert cli.main(["stability", "--out", str(tmp_path / "out"), *wrong]) == 2
    assert not (tmp_path / "out").exists()


def test_what_is_done_is_kept_when_the_rest_breaks_off(tmp_path, monkeypatch):
    def stop(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "SCENARIOS", {"A3": FINE, "A5": replace(FINE, id="A5", run=stop)})
    with pytest.raises(KeyboardInterrupt):
        command.stability(out=tmp_path / "out")
    assert [outcome.id for outcome in read_results(tmp_path / "out" / "results.json").outcomes] == ["A3"]


def test_the_command_writes_a_report(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(command, "SCENARIOS", {"A3": FINE, "A5": replace(FINE, id="A5")})
    out = tmp_path / "out"
    assert cli.main(["stability", "--out", str(out), "--only", "a3", "A3"]) == 0
    printed = capsys.readouterr().out
    report = read_results(out / "results.json")
    assert [outcome.id for outcome in report.outcomes] == ["A3"]
    assert "A3  pass  fails" in printed
    assert "1 of 1 scenarios pass." in printed
    assert report.command == "abcd stability --only A3 --seed 0 --out out"
    before = (out / "results.json").read_bytes()
    assert cli.main(["stability", "--out", str(out), "--only", "A5"]) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert (out / "results.json").read_bytes() == before
