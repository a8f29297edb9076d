"""`abcd plan`: its figures add up, and what would not fit is said."""

import dataclasses
import itertools
import math

import pytest
import torch
from rich.console import Console

from abcd_ns.cli.check.command import check
from abcd_ns.cli.plan.command import Capture, Wanted, forecast, plan, print_forecast
from abcd_ns.cli.plan.forecast import Forecast, shares_of
from abcd_ns.engine.train.memory import DeviceNeeds
from abcd_ns.errors import UserError
from abcd_ns.nerfstudio.inspection import inspect
from abcd_ns.run.fit import FITTED, Fit, blocks_to_begin_with
from abcd_ns.units import GIB
from tests.cli.check.scenes import wide
from tests.data.dataparser_scenes import NAMES, parser, write_model, write_photos
from tests.reference.scenes import random_gaussians, ring_of_views

FITS = {"something": 1}


def capture(count: int = 400) -> Capture:
    points = random_gaussians(count).means
    return Capture(points, torch.full((count, 3), 128, dtype=torch.uint8), ring_of_views(6))


def test_a_forecast_adds_up():
    found = forecast(capture(), Wanted(blocks=4, max_gaussians=1000, steps=100), Console(quiet=True))
    assert (found.fit.blocks, sum(found.points_of_block)) == (4, 400)
    assert found.batch == 4
    assert found.seconds_per_step > 0
    low, high = found.hours
    assert low < high == pytest.approx(low * 1000 / 400)
    needs = DeviceNeeds(48 * 36, 4, levels=3)  # where the CPU is the device, nothing else is kept there
    assert sum(found.shares["device"].values()) == needs.bytes_for(250)
    assert not found.warnings


def test_blocks_whose_number_is_given_have_no_limit_and_are_warned_of():
    """As in training, which fits nothing to the device then."""
    found = forecast(
        capture(), Wanted(blocks=2, max_gaussians=3_000_000, device_budget_gb=0.5), Console(quiet=True)
    )
    assert found.fit.limits == dict.fromkeys(FITTED, 0)
    assert "1,500,000 Gaussians" in next(iter(found.shares["device"]))
    assert any("on the device" in line for line in found.warnings)


def test_workers_for_whom_there_is_no_room_are_refused():
    alone = Fit(blocks=1, limit=0, sole=5000, budget=GIB, gaussians=1000)
    assert blocks_to_begin_with(alone, 0) == 1
    words = r"1\.0 GiB of the device have no room for a block among others"
    with pytest.raises(UserError, match=words) as refused:
        blocks_to_begin_with(alone, 2)
    assert "--" not in str(refused.value)  # `abcd plan` and `ns-train` have other names for it
    assert blocks_to_begin_with(dataclasses.replace(alone, limit=5000), 3) == 6


def test_a_device_budget_decides_how_many_blocks():
    few, many = (
        forecast(capture(), Wanted(max_gaussians=3_000_000, device_budget_gb=gb), Console(quiet=True))
        for gb in (40, 3)
    )
    assert few.fit.blocks_at_the_end == few.fit.blocks == many.fit.blocks == 1
    assert many.fit.blocks_at_the_end > 2
    assert sum(many.shares["device"].values()) <= 3 * GIB


def test_what_does_not_fit_is_helped_by_options_of_this_command():
    small = capture()
    large = [dataclasses.replace(view, width=2600, height=1000) for view in small.views]
    words = r"smaller photos by --downscale \d+, or more memory by --device-budget-gb"
    with pytest.raises(UserError, match=words) as refused:
        forecast(dataclasses.replace(small, views=large), Wanted(device_budget_gb=0.05), Console(quiet=True))
    assert "--pipeline" not in str(refused.value)


def test_large_photos_are_planned_for_as_they_are_trained_on():
    small = capture()
    large = [dataclasses.replace(view, width=2600, height=100) for view in small.views[:3]]
    found = forecast(
        dataclasses.replace(small, views=large), Wanted(device_budget_gb=0.15), Console(quiet=True)
    )
    assert 0 < found.fit.crop_pixels < 260_000
    assert sum(found.shares["device"].values()) <= 0.15 * GIB
    assert not found.warnings


def test_disk_holds_two_generations_and_a_checkpoint():
    fit = Fit(blocks=1, limit=10**9, sole=10**9, budget=GIB, gaussians=1000)
    needs = DeviceNeeds(100, 1)
    shares = shares_of(fit, needs, 0, 1)
    assert sum(shares["disk"].values()) == 1000 * 236 * (2 * 3 + 1)
    assert next(iter(shares["device"].values())) == 1000 * needs.gaussian_bytes


@pytest.fixture(scope="module")
def fits() -> Forecast:
    """Of two blocks, all of it."""
    found = forecast(capture(), Wanted(blocks=2), Console(quiet=True))
    return dataclasses.replace(found, shares=dict.fromkeys(found.shares, FITS))


@pytest.mark.parametrize(
    ("where", "said"), [("device", "on the device"), ("RAM", "of RAM"), ("disk", "of disk")]
)
def test_what_does_not_fit_is_said_with_what_to_do(fits, where, said):
    too_much = dataclasses.replace(fits, shares=fits.shares | {where: {"too much": 2**60}})
    (line,) = too_much.warnings
    assert said in line
    assert ": " in line


def test_days_come_with_a_way_out(fits, capsys):
    assert not fits.advice
    long = dataclasses.replace(fits, seconds_per_step=12.0, factor=4)
    assert "may take 24 days" in long.advice
    assert "--pipeline.max-seconds 7200" in long.advice
    assert "--downscale 8" in long.advice
    print_forecast(long, Console(width=200))
    assert "note: This may take 24 days" in capsys.readouterr().out


@pytest.mark.parametrize(("photos", "points"), [(2, 600), (3, 600), (4, 600), (4, 0)])
def test_plan_and_check_take_what_training_takes(tmp_path, capsys, photos, points):
    """Few photos, and no points: training warns and begins."""
    write_model(tmp_path / "sparse/0", points=points, names=NAMES[:photos], params=wide)
    write_photos(tmp_path / "images", names=NAMES[:photos])
    assert inspect(parser(tmp_path).config).train == photos - 1
    assert check(data=tmp_path) == 0
    assert plan(tmp_path, Wanted(max_gaussians=100, steps=10)) == 0
    said = capsys.readouterr().out
    assert "few-photos" in said
    assert "does not fit" not in said


def test_the_screen_is_short_and_says_more_when_asked(capsys):
    found = forecast(capture(), Wanted(blocks=4), Console(quiet=True))
    print_forecast(found, Console(width=120))
    short = capsys.readouterr().out
    assert len(short.splitlines()) < 10
    assert "All of it fits" in short
    for word in ("blocks", "400 points", "time", "device", "RAM", "disk"):
        assert word in short
    print_forecast(found, Console(width=120), verbose=True)
    shown = capsys.readouterr().out
    for what in itertools.chain(*found.shares.values()):
        assert what in shown
        assert what not in short
    assert "points by block" in shown
    assert math.isfinite(found.hours[1])


def test_workers_need_blocks_to_go_round_and_what_they_are_sent_is_said(capsys):
    alone, found = (
        forecast(capture(), Wanted(max_gaussians=600, workers=n), Console(quiet=True)) for n in (1, 3)
    )
    assert (alone.fit.blocks, found.fit.blocks) == (1, 6)
    numbers = DeviceNeeds(48 * 36, 4).parameter_bytes
    block, around = found.shares["sent a visit"].values()
    assert block == 2 * 3 * 100 * numbers  # with both moments, there and back
    assert around == 500 * numbers
    more = sum(found.shares["RAM"].values()) - sum(alone.shares["RAM"].values())
    assert more == 600 * numbers + 6 * block  # six visits are out at once
    print_forecast(alone, Console(width=120))
    assert "sent" not in capsys.readouterr().out
    print_forecast(found, Console(width=120), verbose=True)
    shown = capsys.readouterr().out
    assert all(what in shown for what in found.shares["sent a visit"])


@pytest.mark.parametrize(
    "option",
    [
        {"blocks": -1},
        {"blocks": 65_537},
        {"steps": 0},
        {"max_gaussians": -5},
        {"workers": 0},
        {"downscale": 0},
        *({"device_budget_gb": value} for value in (-1.0, math.nan, math.inf)),
    ],
)
def test_options_out_of_range_are_refused(tmp_path, option):
    with pytest.raises(UserError, match=next(iter(option)).replace("_", "-")):
        plan(tmp_path, Wanted(**option) if "downscale" not in option else Wanted(), option.get("downscale"))
