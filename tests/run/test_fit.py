"""The number of blocks and what is drawn of views follow from the device's budget; the
RAM budget is shared out whole. What that one does to a run is in test_resume.py."""

import dataclasses
import re

import psutil
import pytest
from hypothesis import given
from hypothesis import strategies as st

from abcd_ns.engine.layers.layer_renderer import BYTES_PER_PIXEL, PARTS_BYTES
from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.train.density.control import DensityConfig
from abcd_ns.engine.train.memory import DeviceNeeds, coarse_model_size, degree_with_room, levels_of, limits_at
from abcd_ns.engine.train.recipe import FULL
from abcd_ns.errors import UserError
from abcd_ns.run.fit import FEW, LEAST_BLOCK, Demand, Fit, RamShares, find_fit, fit_run
from abcd_ns.run.options import RunOptions
from abcd_ns.units import GIB
from tests.reference.scenes import training_config

TRAINING = TrainingConfig()
PIXELS = 1297 * 840
"""Of garden at a quarter of its size."""
GARDEN = 5187 * 3361
MP = 1_000_000
POINTS = 140_000


def fit_for(gb: float, pixels: int, points: int = POINTS, most: int | None = None, **training) -> Fit:
    density = DensityConfig(max_gaussians=most or 0)
    return find_fit(int(gb * GIB), Demand(pixels, points, training_config(density=density, **training)))


def needs_of(fit: Fit, pixels: int, blocks: int) -> DeviceNeeds:
    options = {"crop_pixels": fit.limits.crop_pixels, "levels": levels_of(blocks), "in_parts": blocks > 1}
    return DeviceNeeds(pixels, 1, **options, active_degree=3 - fit.limits.late_harmonics)


def peak_of(needs: DeviceNeeds, gaussians: int) -> int:
    """Of a visit to a block, bytes; layers and photos that are kept left out."""
    return needs.fixed_bytes + gaussians * needs.gaussian_bytes


@pytest.mark.parametrize("gaussians", [10_000, 1_000_000, 30_000_000])
@pytest.mark.parametrize("gb", [4, 8, 24, 80])
def test_every_block_fits_the_budget_and_one_fewer_would_not(gaussians, gb):
    fit = fit_for(gb, PIXELS, gaussians)
    assert (fit.limits.batch_limit, fit.limits.crop_pixels) == (1, 0)
    for blocks in (1, max(fit.blocks_at_the_end, 2)):
        needs, limit = needs_of(fit, PIXELS, blocks), fit.limits.of_block(blocks)
        left = needs.left(gb * GIB)
        assert left == gb * GIB * (7 if blocks == 1 else 6) // 8
        assert peak_of(needs, limit) <= left < peak_of(needs, limit + 1)
    assert (fit.blocks == 1) == (gaussians <= FULL * fit.limits.sole_limit)
    if fit.blocks > 1:
        assert gaussians <= fit.blocks * FULL * fit.limits.block_limit
        assert fit.blocks == 2 or gaussians > (fit.blocks - 1) * FULL * fit.limits.block_limit


@pytest.mark.parametrize(
    ("gb", "pixels", "whole"),
    [
        (4, 2 * MP, True),  # a laptop with 16 GB of RAM
        (8, 12 * MP, False),
        (10, 12 * MP, True),
        (8, GARDEN, False),
        (16, GARDEN, True),
    ],
)
def test_large_photos_are_trained_on_by_parts(gb, pixels, whole):
    fit = fit_for(gb, pixels)
    assert (fit.blocks, fit.limits.crop_pixels == 0) == (1, whole)
    assert min(fit.limits.block_limit, fit.limits.sole_limit) > POINTS
    for blocks in (1, max(fit.blocks_at_the_end, 2)):
        needs, limit = needs_of(fit, pixels, blocks), fit.limits.of_block(blocks)
        assert peak_of(needs, limit) <= needs.left(int(gb * GIB))
    said = fit.in_words()
    assert "\n" not in said
    assert ("parts of" in said) != whole


@pytest.mark.parametrize("points", [140_000, 3_000_000])
@pytest.mark.parametrize("pixels", [PIXELS, 2 * MP, 12 * MP, GARDEN])
def test_with_more_memory_no_less_is_drawn(pixels, points):
    crops = [fit_for(gb, pixels, points).limits.crop_pixels for gb in (8, 10, 12, 16, 24, 40, 60, 80)]
    drawn = [min(crop or pixels, pixels) for crop in crops]
    assert drawn == sorted(drawn)
    assert drawn[-1] == pixels


def test_a_deep_tree_leaves_less_room_where_photos_are_large():
    few, many = (
        fit_for(12, GARDEN, 100_000, most=most, crop_pixels=4 * MP) for most in (10_000_000, 200_000_000)
    )
    assert many.blocks_at_the_end > few.blocks_at_the_end > 1
    assert many.limits.block_limit < few.limits.block_limit
    needs = needs_of(many, GARDEN, many.blocks_at_the_end)
    assert needs.drawing_bytes > needs.step_bytes
    assert peak_of(needs, many.limits.block_limit) <= needs.left(12 * GIB)


@given(side=st.integers(100, 6000), batch=st.integers(1, 4))
def test_layers_that_are_folded_take_no_more_than_the_steps_that_follow(side, batch):
    needs = DeviceNeeds(side**2, batch)
    beside = needs.drawing_bytes - max(PARTS_BYTES, needs.levels * BYTES_PER_PIXEL * needs.pixels)
    assert PARTS_BYTES <= needs.parts_bytes <= max(needs.fixed_bytes - beside, PARTS_BYTES)


@pytest.mark.parametrize("blocks", [1, 2])
def test_a_block_at_its_limit_takes_as_much_with_more_harmonics(blocks):
    fit = fit_for(8, PIXELS, 30_000_000)
    training = training_config(**vars(fit.limits))
    growing, most = needs_of(fit, PIXELS, blocks), training.limits.of_block(blocks)
    assert training.growing_degree == 3 - fit.limits.late_harmonics < 3
    for degree in range(training.growing_degree + 1, 4):
        few = limits_at(training, degree).of_block(blocks)
        needs = dataclasses.replace(growing, active_degree=degree)
        assert peak_of(needs, few) <= peak_of(growing, most) < peak_of(needs, few + 2)
        if blocks == 1:
            assert degree_with_room(training, int(FULL * few)) == degree
            assert degree_with_room(training, int(FULL * few) + 1) == degree - 1


def test_as_many_harmonics_come_late_as_blocks_would_be_many():
    fits = [fit_for(8, PIXELS, millions * 10**6) for millions in (1, 10, 18, 300)]
    assert [fit.limits.late_harmonics for fit in fits] == [0, 0, 2, 3]
    assert [fit.blocks <= FEW for fit in fits] == [True, True, True, False]
    assert "Harmonics" not in fits[1].in_words()
    assert "Harmonics of the 2 highest degrees come after growth." in fits[2].in_words()


def test_a_cpu_keeps_layers_and_photos_under_another_budget():
    demand = Demand(PIXELS, 10_000_000, TRAINING)
    device, cpu = (find_fit(8 * GIB, dataclasses.replace(demand, on_cpu=on_cpu)) for on_cpu in (False, True))
    needs = dataclasses.replace(needs_of(cpu, PIXELS, cpu.blocks_at_the_end), keeps=False)
    assert needs.left(8 * GIB) == 8 * GIB
    assert (needs.layer_bytes(8 * GIB), needs.photo_bytes(8 * GIB)) == (0, 0)
    assert peak_of(needs, cpu.limits.block_limit) <= 8 * GIB < peak_of(needs, cpu.limits.block_limit + 1)
    assert cpu.limits.block_limit > device.limits.block_limit


def test_what_is_set_is_kept():
    assert fit_for(80, 2 * MP, crop_pixels=5000).limits.crop_pixels == 5000
    assert fit_for(80, 2 * MP, batch_limit=2).limits.batch_limit == 2
    assert coarse_model_size(training_config(coarse_gaussians=500), 3_333, PIXELS) == 500


def test_a_scene_that_fits_in_one_block_needs_no_room_for_layers():
    fit = fit_for(0.3, 100_000, 2_000)
    assert (fit.blocks, fit.limits.block_limit, fit.blocks_at_the_end) == (1, 0, 1)
    assert "no room for the layers" in fit.in_words()
    with pytest.raises(UserError):
        fit_for(0.3, 100_000, 2_000_000)
    with pytest.raises(UserError):  # a run that has two blocks already
        find_fit(int(0.3 * GIB), Demand(100_000, 2_000, TRAINING, blocks=2))


@pytest.mark.parametrize("block", [1, 3_333, 5_000_000])
@pytest.mark.parametrize("pixels", [160 * 106, PIXELS])
def test_the_warm_up_takes_what_a_step_of_a_visit_takes_and_no_more(block, pixels):
    size = coarse_model_size(TRAINING, block, pixels)
    visit, warm_up = (DeviceNeeds(pixels, batch, levels=0) for batch in (4, 1))  # forced blocks: all at once
    assert peak_of(warm_up, size) <= peak_of(visit, block) < peak_of(warm_up, size + 1)
    assert size > block
    assert coarse_model_size(training_config(batch=1, crop_pixels=900), block, pixels) == block


def test_what_a_scene_may_become_is_no_reason_to_cut_it_now():
    grows = fit_for(24, PIXELS, 2_000_000, most=120_000_000)
    assert (grows.blocks, grows.blocks_at_the_end > 10) == (1, True)
    assert fit_for(24, PIXELS, 200_000_000).blocks >= 9
    assert fit_for(24, PIXELS, 200_000_000, most=2_000_000).blocks == 1


@pytest.mark.parametrize(
    ("gb", "pixels", "points"),
    [(0.1, PIXELS, POINTS), (2, GARDEN, 5_000_000), (0.05, 10_000, 60 * LEAST_BLOCK)],
)
def test_a_refusal_names_options_that_help(gb, pixels, points):
    demand = Demand(pixels, points, TRAINING, factor=2)
    with pytest.raises(UserError) as caught:
        find_fit(int(gb * GIB), demand)
    said = str(caught.value)
    assert f"{gb:.2f} GiB may be taken" in said
    least = float(re.search(r"--pipeline\.device-budget-gb (\S+),", said)[1])
    assert f"takes {least:.2f} GiB" in said
    assert least > gb
    assert find_fit(int((least + 0.01) * GIB), demand).blocks >= 1
    with pytest.raises(UserError):
        find_fit(int((least - 0.03) * GIB), demand)
    if factor := re.search(r"--pipeline\.datamanager\.dataparser\.downscale-factor (\d+)", said):
        times = int(factor[1]) // 2
        assert find_fit(int(gb * GIB), demand.reduced(times)).blocks >= 1


def test_room_for_gaussians_alone_may_be_too_little_too():
    with pytest.raises(UserError, match="have room for 1 Gaussians"):
        fit_run(RunOptions(gaussian_bytes=2000), GIB, PIXELS, 1, POINTS, on_cpu=True)
    assert fit_run(RunOptions(gaussian_bytes=GIB), 0, PIXELS, 1, POINTS, on_cpu=True).blocks == 1


def test_what_isolated_blocks_may_hold_is_said():
    options = RunOptions(gaussian_bytes=GIB // 8, training=training_config(overlap=0.2, layers=False))
    fit = fit_run(options, 0, PIXELS, 1, POINTS, on_cpu=True)
    assert fit.limits.block_limit == 0  # none is cut
    assert f"allow {fit.limits.sole_limit:,} Gaussians in a block: {fit.blocks} blocks" in fit.in_words()
    assert "each stops growing" in fit.in_words()


@given(st.integers(1, 2**50))
def test_shares_of_ram_add_up(budget):
    shares = RamShares.of(budget / GIB)
    assert sum(vars(shares).values()) == budget
    assert min(vars(shares).values()) >= 0


def test_the_automatic_ram_budget_is_a_part_of_the_machines():
    automatic = sum(vars(RamShares.of(0.0)).values())
    assert 0 < automatic <= min(8 * 2**30, psutil.virtual_memory().total // 2)
