"""The number of blocks follows from the device's budget."""

import pytest

from abcd_ns.engine.config import TrainingConfig
from abcd_ns.engine.memory import DeviceNeeds, scaffold_size
from abcd_ns.engine.schedule import WARM_UP_BATCH
from abcd_ns.engine.splitting import FULL
from abcd_ns.errors import UserError
from abcd_ns.plugin.room import GB, check_room, device_budget, find_room

TRAINING = TrainingConfig()
PIXELS = 1297 * 840


@pytest.mark.parametrize("gaussians", [10_000, 1_000_000, 30_000_000])
@pytest.mark.parametrize("gb", [3, 8, 24, 80])
def test_every_block_fits_the_budget_and_one_fewer_would_not(gaussians, gb):
    room = find_room(gb * GB, pixels=PIXELS, points=gaussians, training=TRAINING)
    for limit, views in ((room.sole, 1), (room.limit, 4)):
        needs = DeviceNeeds(PIXELS, views)
        assert needs.bytes_for(limit) <= gb * GB < needs.bytes_for(limit + 1)
    assert (room.blocks == 1) == (gaussians <= FULL * room.sole)
    if room.blocks > 1:
        assert gaussians <= room.blocks * FULL * room.limit
        assert room.blocks == 2 or gaussians > (room.blocks - 1) * FULL * room.limit


@pytest.mark.parametrize("block", [1, 3_333, 5_000_000])
@pytest.mark.parametrize("pixels", [160 * 106, PIXELS])
def test_the_warm_up_takes_what_a_visit_takes_and_no_more(block, pixels):
    size = scaffold_size(TRAINING, block, pixels)
    visit, warm_up = DeviceNeeds(pixels, batch=4), DeviceNeeds(pixels, batch=WARM_UP_BATCH)
    assert warm_up.bytes_for(size) <= visit.bytes_for(block) < warm_up.bytes_for(size + 1)
    assert size > block


def test_the_warm_up_is_larger_than_a_block_and_smaller_than_a_sole_one():
    room = find_room(8 * GB, pixels=PIXELS, points=30_000_000, training=TRAINING)
    assert room.limit < scaffold_size(TRAINING, room.limit, PIXELS) < room.sole


def test_the_warm_up_has_the_size_that_is_asked_for():
    assert scaffold_size(TrainingConfig(scaffold_gaussians=500), 3_333, PIXELS) == 500


def test_with_one_view_in_a_step_the_warm_up_is_no_larger_than_a_block():
    assert scaffold_size(TrainingConfig(batch=1), 3_333, PIXELS) == 3_333


def test_a_scene_that_fits_is_one_block():
    def room(points, most=None):
        return find_room(24 * GB, pixels=PIXELS, points=points, most=most, training=TRAINING)

    assert room(2_000_000).blocks == 1
    assert room(200_000_000).blocks > 10
    # What it may become is no reason to cut it now; what it may not become is none either.
    assert room(2_000_000, most=100_000_000).blocks == 1
    assert room(2_000_000, most=100_000_000).blocks_at_the_end > 10
    assert room(200_000_000, most=2_000_000).blocks == 1


def test_a_budget_too_small_for_any_block_names_the_least():
    with pytest.raises(
        UserError, match=r"--pipeline\.device-budget-gb 0\.25 .* give (\S+) or more"
    ) as caught:
        check_room(GB // 4, PIXELS, TRAINING)
    least = float(str(caught.value).split("give ")[1].split()[0])
    check_room(int((least + 0.01) * GB), PIXELS, TRAINING)


def test_the_budget_is_what_is_wanted_or_a_share_of_what_there_is():
    assert device_budget(3.0, "cpu") == 3 * GB
    assert device_budget(0.0, "cpu") > 0
