"""What the terminal says of a run: the time left, alarms at once, the blocks' standing at the end."""

import io
import re
from dataclasses import replace
from types import SimpleNamespace

import pytest
from rich.console import Console

from abcd_ns.engine.events import HeldOutScored, Pruning, Repaired, StepTaken, VisitBegan
from abcd_ns.engine.layers.footprints import VisitGeometry
from abcd_ns.engine.train.run_state import BlockHealth, Stopwatch
from abcd_ns.nerfstudio.run import progress
from abcd_ns.nerfstudio.run.progress import ProgressReport
from tests.reference.scenes import make_coordinator, random_gaussians, ring_of_views


@pytest.fixture
def coordinator(tmp_path):
    return make_coordinator(tmp_path, random_gaussians(40), ring_of_views(3), blocks=3)


def test_the_live_line_fits_the_terminal(coordinator, monkeypatch):
    """What matters less is left out. nerfstudio's console is made 120 wide, whatever the terminal is."""
    file = io.StringIO()
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr(progress, "CONSOLE", Console(file=file, force_terminal=True, width=120))
    monkeypatch.setattr(progress, "SECONDS_BETWEEN_LOOKS", 0.0)
    coordinator.run.stopwatch = Stopwatch(60.0)
    coordinator.state.step = 1
    report = ProgressReport(coordinator)
    report(VisitBegan(0, 0, 2, steps=1000, views=3, gaussians=40))
    report(StepTaken(1, 0, 999, psnr=20.0))
    report._live.refresh()
    report(Pruning(2, 8))
    report._live.refresh()
    lines = [re.sub(r"\x1b\[[0-9?]*[a-zA-Z]", "", line) for line in re.split(r"[\r\n]", file.getvalue())]
    live = r"block 3/3 step 999/1000  \d:\d\d:\d\d left  20.00 dB training"
    assert any(re.search(live, line) for line in lines)
    assert any("final pruning 2/8" in line for line in lines)
    assert max(len(line.rstrip()) for line in lines) < 80


def test_what_is_no_number_is_said_at_once(coordinator, capsys):
    report = ProgressReport(coordinator)
    report(Repaired(4, 1, "gradients", 12))
    report(Repaired(4, None, "values", 1))
    report(Repaired(4, 1, "transparent", 5))
    assert capsys.readouterr().out.splitlines() == [
        "block 2: 12 gradients that were no numbers set to zero",
        "warm-up: 1 Gaussians that were no numbers replaced",
    ]


def test_the_end_names_blocks_that_were_not_simply_trained(coordinator, capsys):
    coordinator.state.views = {0: 3, 1: 0, 2: 1}
    coordinator.state.health = {0: BlockHealth(visits=2, oversized=3, hidden=True), 2: BlockHealth(visits=1)}
    ProgressReport(coordinator).close()
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("Trained 0 steps in 0 visits")
    assert lines[1:] == [
        "  block 1: hidden behind others, passed over",
        "  block 2: seen by no view, left as it was",
        "  block 3: seen by 1 view only",
        "  3 oversized Gaussians shrunk",
    ]


def test_a_run_that_stops_within_a_visit_says_which(coordinator, capsys):
    coordinator.state.health = {0: BlockHealth(visits=1), 2: BlockHealth()}
    coordinator.state.active = SimpleNamespace(geometry=VisitGeometry(2, {}))
    ProgressReport(coordinator).close()
    assert capsys.readouterr().out.splitlines()[1:] == [
        "  block 1: trained",
        "  block 2: not visited yet",
        "  block 3: in training when stopped",
    ]


def test_the_end_names_the_degree_of_harmonics_where_not_all_came(coordinator, capsys):
    config = coordinator.config
    coordinator.config = replace(config, sh_degree=3, limits=replace(config.limits, late_harmonics=2))
    coordinator.state.health, coordinator.state.sh_degree = {0: BlockHealth(visits=2)}, 1
    ProgressReport(coordinator).close()
    assert "  harmonics up to degree 1 of 3: others had no room, or no time" in capsys.readouterr().out
    coordinator.state.sh_degree = 3
    ProgressReport(coordinator).close()
    assert "harmonics" not in capsys.readouterr().out


def test_the_end_tells_held_out_psnr_where_it_was_measured_after_the_last_step(coordinator, capsys):
    report = ProgressReport(coordinator)
    report(HeldOutScored(11.0, None))
    report(StepTaken(1, 0, 1, psnr=20.0))
    report.close()
    assert "PSNR 20.00 dB on training crops" in capsys.readouterr().out
    report(HeldOutScored(19.5, 0.7))
    report.close()
    said = capsys.readouterr().out
    assert "held-out PSNR 19.50 dB" in said
    assert "crops" not in said
