"""`abcd plan`: its figures add up, and what would not fit is said."""

import dataclasses
import itertools
import json
import math
from pathlib import Path
from statistics import fmean

import pytest
import torch
from rich.console import Console

from abcd_ns.cli.check.command import check
from abcd_ns.cli.plan import Wanted
from abcd_ns.cli.plan.command import plan
from abcd_ns.cli.plan.forecast import LOST, Capture, Forecast, forecast, print_forecast
from abcd_ns.engine.train.memory import DeviceNeeds
from abcd_ns.engine.train.recipe import Limits
from abcd_ns.errors import UserError
from abcd_ns.nerfstudio.inspection import inspect
from abcd_ns.run.fit import Fit, blocks_to_begin_with
from abcd_ns.units import GIB
from tests.cli.test_check import wide
from tests.data.dataparser_scenes import NAMES, parser, write_capture
from tests.reference.scenes import random_gaussians, ring_of_views

FULL = Fit(1, GIB, 1000, Limits(sole_limit=5000))
BUDGETS = Path(__file__).parents[2] / "docs" / "results" / "budgets"


def capture(count: int = 400) -> Capture:
    points = random_gaussians(count).means
    return Capture(points, torch.full((count, 3), 128, dtype=torch.uint8), ring_of_views(6))


def planned(wanted: Wanted, of: Capture | None = None) -> Forecast:
    return forecast(of or capture(), wanted, Console(quiet=True))


def test_a_forecast_adds_up():
    found = planned(Wanted(blocks=4, max_gaussians=1000, steps=100))
    assert (found.fit.blocks, sum(found.points_of_block)) == (4, 400)
    assert found.batch == 4
    assert found.seconds_per_step > 0
    low, high = found.hours
    assert low < high == pytest.approx(low * 1000 / 400)
    needs = DeviceNeeds(48 * 36, 4, levels=3)  # where the CPU is the device, nothing else is kept there
    assert sum(found.shares["device"].values()) == needs.fixed_bytes + 250 * needs.gaussian_bytes
    parameters = 1000 * needs.parameter_bytes  # on disk with both moments, twice, and as a checkpoint
    assert sum(found.shares["disk"].values()) == parameters * (2 * 3 + 1)
    assert not found.warnings
    assert not found.advice
    for place, said in (("device", "on the device"), ("RAM", "of RAM"), ("disk", "of disk")):
        shares = found.shares | {place: {"too much": 2**60}}
        (line,) = dataclasses.replace(found, shares=shares).warnings
        assert said in line
        assert ": " in line


def test_blocks_whose_number_is_given_have_no_limit_and_are_warned_of():
    """As in training, which fits nothing to the device then."""
    found = planned(Wanted(blocks=2, max_gaussians=3_000_000, device_budget_gb=0.5))
    assert found.fit.limits == Limits()
    assert "1,500,000 Gaussians" in next(iter(found.shares["device"]))
    assert any("on the device" in line for line in found.warnings)


def test_a_device_budget_decides_how_many_blocks():
    few, many = (planned(Wanted(max_gaussians=3_000_000, device_budget_gb=gb)) for gb in (40, 3))
    assert few.fit.blocks_at_the_end == few.fit.blocks == many.fit.blocks == 1
    assert many.fit.blocks_at_the_end > 2
    assert sum(many.shares["device"].values()) <= 3 * GIB
    assert few.quality is None
    assert many.quality.startswith("up to ")


def test_what_less_memory_costs_is_what_was_measured():
    """The most that a stored run of `abcd` lies below one block without a limit, rounded up."""
    worst = dict.fromkeys(LOST, 0.0)
    for file in sorted(BUDGETS.glob("*.json")):
        arms = json.loads(file.read_text())["arms"]
        runs = {(arm["method"], arm["value"]): arm["runs"] for arm in arms}
        joint = runs["abcd-monolithic", None]
        psnr = fmean(run["psnr_merged"] for run in joint)
        held = max(run["gaussian_bytes"] for run in joint)
        for share in LOST if "640" not in file.name else ():
            limited = fmean(run["psnr_merged"] for run in runs["abcd", int(held * share)])
            worst[share] = max(worst[share], psnr - limited)
    assert {share: math.ceil(10 * lost) / 10 for share, lost in worst.items()} == LOST


def with_photos_of(width: int, height: int) -> Capture:
    small = capture()
    large = [dataclasses.replace(view, width=width, height=height) for view in small.views[:3]]
    return dataclasses.replace(small, views=large)


def test_large_photos_are_planned_for_as_they_are_trained_on():
    found = planned(Wanted(device_budget_gb=0.15), with_photos_of(2600, 100))
    assert 0 < found.fit.limits.crop_pixels < 260_000
    assert sum(found.shares["device"].values()) <= 0.15 * GIB
    assert not found.warnings
    # What does not fit is helped by options of this command.
    words = r"smaller photos by --downscale \d+, or more memory by --device-budget-gb"
    with pytest.raises(UserError, match=words) as refused:
        planned(Wanted(device_budget_gb=0.05), with_photos_of(2600, 1000))
    assert "--pipeline" not in str(refused.value)


@pytest.mark.parametrize(("photos", "points"), [(2, 600), (4, 0)])
def test_plan_and_check_take_what_training_takes(tmp_path, capsys, photos, points):
    write_capture(tmp_path, NAMES[:photos], points=points, params=wide)
    assert inspect(parser(tmp_path).config).train == photos - 1
    assert check(data=tmp_path) == 0
    assert plan(tmp_path, Wanted(max_gaussians=100, steps=10)) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert f"few-photos: There are only {photos} photos, {photos - 1} of them to train on" in said
    assert "eval-mode all" in said
    assert "does not fit" not in said


def test_the_screen_says_more_when_asked(capsys):
    found = dataclasses.replace(planned(Wanted(blocks=4)), seconds_per_step=12.0, factor=4)
    print_forecast(found, Console(width=200))
    short = capsys.readouterr().out
    print_forecast(found, Console(width=200), verbose=True)
    shown = capsys.readouterr().out
    for what in itertools.chain(*found.shares.values()):
        assert what in shown
        assert what not in short
    for word in ("This may take 24 days", "max-seconds 7200", "--downscale 8"):
        assert word in shown


def test_workers_need_blocks_to_go_round_and_what_they_are_sent_is_said(capsys):
    with pytest.raises(UserError, match=r"1\.0 GiB of the device have no room for a block among others"):
        blocks_to_begin_with(FULL, 2)
    alone, found = (planned(Wanted(max_gaussians=600, workers=n)) for n in (1, 3))
    assert (alone.fit.blocks, found.fit.blocks) == (1, 6)
    numbers = DeviceNeeds(48 * 36, 4).parameter_bytes
    block, around = found.shares["sent a visit"].values()
    assert block == 2 * 3 * 100 * numbers  # with both moments, there and back
    assert around == 500 * numbers
    more = sum(found.shares["RAM"].values()) - sum(alone.shares["RAM"].values())
    assert more == 600 * numbers + 6 * block  # six visits are out at once
    assert "sent a visit" not in alone.shares
    print_forecast(found, Console(width=120), verbose=True)
    shown = capsys.readouterr().out
    assert all(what in shown for what in found.shares["sent a visit"])


def test_options_out_of_range_are_refused(tmp_path):
    for wanted, option in (
        (Wanted(blocks=-1), "blocks"),
        (Wanted(blocks=65_537), "blocks"),
        (Wanted(max_gaussians=-5), "max-gaussians"),
        (Wanted(workers=0), "workers"),
        (Wanted(device_budget_gb=-1.0), "device-budget-gb"),
        (Wanted(device_budget_gb=math.nan), "device-budget-gb"),
    ):
        with pytest.raises(UserError, match=f"--{option}"):
            plan(tmp_path, wanted)
    with pytest.raises(UserError, match="--downscale is 0"):
        plan(tmp_path, Wanted(), downscale=0)


def test_a_limit_below_the_points_is_what_training_begins_with(capsys):
    found = planned(Wanted(blocks=2, max_gaussians=100))
    assert sum(found.points_of_block) == 100
    assert len(set(found.hours)) == 1
    print_forecast(found, Console(width=120))
    assert "100 points to begin with, 100 expected" in capsys.readouterr().out
