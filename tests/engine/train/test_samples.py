"""What steps show: parts of crops, right on average; pictures that grow with the run."""

import itertools
import random

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from abcd_ns.engine.kernels.photometric import SSIM_WINDOW
from abcd_ns.engine.render import TorchRasterizer
from abcd_ns.engine.train import schedule
from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.train.schedule import reduction_at
from abcd_ns.engine.train.step.batch import ALIGN, Sample, part_to_draw, random_part
from abcd_ns.engine.types import Crop
from tests.reference.scenes import STILL, assert_resumes, random_gaussians, ring_of_views, training_config

CROPS = st.builds(Crop, st.integers(0, 200), st.integers(0, 200), st.integers(1, 2000), st.integers(1, 2000))


class Fixed(random.Random):
    """Gives the numbers that it is told, in turn, and notes the ranges that it was asked for."""

    def __init__(self, numbers: tuple[int, ...] = ()) -> None:
        super().__init__()
        self.numbers, self.ranges = list(numbers), []

    def randrange(self, stop: int) -> int:  # as it is called
        self.ranges.append(stop)
        return self.numbers[len(self.ranges) - 1] if self.numbers else 0


def all_parts(crop: Crop, most: int) -> list[Crop]:
    """Every part that may be drawn, as often as it is likely."""
    asked = Fixed()
    random_part(crop, most, asked)
    choices = itertools.product(*map(range, asked.ranges))
    return [random_part(crop, most, Fixed(numbers)) for numbers in choices]


@given(CROPS, st.integers(1, 3_000_000), st.integers())
def test_parts_lie_in_the_crop_keep_to_the_limit_and_meet_at_whole_tiles(crop, most, seed):
    part = random_part(crop, most, random.Random(seed))
    if crop.pixels <= most:
        assert part == crop
        return
    inside = part.within(crop)
    assert min(inside.x, inside.y) >= 0 < min(part.width, part.height)
    assert inside.x + part.width <= crop.width
    assert inside.y + part.height <= crop.height
    assert part.pixels <= max(most, ALIGN * ALIGN)
    for edge in (part.x, part.x + part.width):
        assert edge in (crop.x, crop.x + crop.width) or edge % ALIGN == 0
    for edge in (part.y, part.y + part.height):
        assert edge in (crop.y, crop.y + crop.height) or edge % ALIGN == 0


@given(CROPS, st.integers(300_000, 3_000_000), st.integers())
def test_parts_use_most_of_what_they_may(crop, most, seed):
    parts = [random_part(crop, most, random.Random(f"{seed} {k}")).pixels for k in range(200)]
    assert sum(parts) / 200 > 0.25 * min(most, crop.pixels)


@pytest.mark.parametrize("background", [0.0, 0.4])
@pytest.mark.parametrize("pixel_loss", ["l1", "l2"])
def test_the_loss_of_parts_is_on_average_that_of_the_whole(background, pixel_loss):
    crop, view = Crop(8, 5, 40, 28), ring_of_views(1)[0]
    config = training_config(ssim_lambda=0.0, pixel_loss=pixel_loss)
    generator = torch.Generator().manual_seed(0)
    picture = torch.rand(28, 40, 3, generator=generator, dtype=torch.float64)
    photo = torch.full_like(picture, background)

    def loss(part: Crop) -> torch.Tensor:
        sample = Sample(view, part, None, None, photo[0, 0], share=part.pixels / crop.pixels)
        place = part.within(crop).slices
        return sample.loss(picture[place], photo[place], config)

    parts = all_parts(crop, 500)
    assert torch.stack([loss(part) for part in parts]).mean() == pytest.approx(loss(crop).item())


@settings(max_examples=10)
@given(st.integers(0, 40), st.integers(500, 3000), st.sampled_from([50_000, 200_000, 900_000]))
def test_a_line_between_columns_crosses_an_ssim_window_one_time_in_five_at_most(x, width, most):
    crop = Crop(x, 0, width, 2000)
    asked = Fixed()
    random_part(crop, most, asked)
    if len(asked.ranges) < 4:  # rows alone
        return
    for start in range(0, width - SSIM_WINDOW, 37):
        parts = [random_part(crop, most, Fixed((shift, start, 0, 0))) for shift in range(asked.ranges[0])]
        whole = sum(x + start + SSIM_WINDOW <= part.x + part.width for part in parts)
        assert whole >= 0.8 * len(parts)


def test_a_part_depends_on_seed_step_and_place_alone():
    crop = Crop(0, 0, 640, 480)
    config = training_config(crop_pixels=40_000)
    drawn = [part_to_draw(config, crop, step, place) for step in range(20) for place in range(4)]
    again = [part_to_draw(config, crop, step, place) for step in range(20) for place in range(4)]
    assert drawn == again
    assert len(set(drawn)) > 20
    assert part_to_draw(training_config(crop_pixels=40_000, seed=1), crop, 0, 0) != drawn[0]
    assert part_to_draw(TrainingConfig(), crop, 0, 0) == crop


@pytest.mark.parametrize("room", [0, 1 << 20])
def test_a_part_of_a_batch_shows_what_the_whole_shows_there(make, room):
    pictures = []
    for most in (0, 700):
        coordinator = make(str(most), blocks=4, steps=8, crop_pixels=most, density=STILL, layer_bytes=room)
        batch = coordinator.next_batch()
        pictures.append((batch.samples, coordinator.render(batch).pictures))
    whole, parts = pictures
    assert any(sample.share < 1 for sample in parts[0])
    for big, small, picture, part in zip(whole[0], parts[0], whole[1], parts[1], strict=True):
        assert small.share == pytest.approx(small.crop.pixels / big.crop.pixels)
        assert torch.equal(picture[small.crop.within(big.crop).slices], part)


def test_a_run_on_reduced_parts_that_stops_and_goes_on_is_the_run_that_did_not(make, photos, monkeypatch):
    monkeypatch.setattr(schedule, "LEAST_SIDE", 9)  # pictures of 48 x 36 px are reduced, too
    assert_resumes(make, photos, 6, blocks=4, steps=14, crop_pixels=600, coarse=0.7)


def test_pictures_grow_by_share_and_never_become_too_small():
    shares = [0.0, 0.19, 0.2, 0.39, 0.4, 1.0]
    assert [reduction_at(share, 0.4, 640) for share in shares] == [4, 4, 2, 2, 1, 1]
    assert [reduction_at(share, 0.4, 213) for share in shares] == [2, 2, 2, 2, 1, 1]
    assert {reduction_at(share, 0.4, 120) for share in shares} == {1}
    assert {reduction_at(share, 0.0, 640) for share in shares} == {1}


@pytest.mark.parametrize("by", [1, 2, 4])
def test_a_reduced_camera_sees_the_same_in_larger_pixels(by):
    (view,) = ring_of_views(1, width=50, dtype=torch.float64)
    gaussians = random_gaussians(20).to(torch.float64)
    small = view.reduced(by)
    assert (small.width, small.height, small.reduction) == (50 // by, 36 // by, by)
    found, full = (TorchRasterizer().project(gaussians, each) for each in (small, view))
    torch.testing.assert_close(found.means2d * by, full.means2d)
    torch.testing.assert_close(found.depths, full.depths)


def test_a_reduced_photo_is_the_mean_of_its_squares():
    (view,) = ring_of_views(1)
    sample = Sample(view.reduced(4), Crop(2, 1, 5, 6), None, None, torch.zeros(3))
    assert sample.source == Crop(8, 4, 20, 24)
    photo = torch.rand(24, 20, 3)
    expected = photo.view(6, 4, 5, 4, 3).mean(dim=(1, 3))
    torch.testing.assert_close(sample.reduced(photo), expected)


def test_alpha_and_masks_are_reduced_with_what_they_stand_for():
    (view,) = ring_of_views(1)
    sample = Sample(view.reduced(2), Crop(0, 0, 3, 2), None, None, torch.zeros(3))
    photo, behind = torch.rand(4, 6, 4), torch.rand(3)
    photo[:2, :2, 3] = 0.0

    def composited(pixels):
        return pixels[..., 3:] * pixels[..., :3] + (1 - pixels[..., 3:]) * behind

    torch.testing.assert_close(composited(sample.reduced(photo)), sample.reduced(composited(photo)))
    mask = torch.ones(4, 6, 1, dtype=torch.bool)
    mask[0, 0] = False
    found = sample.reduced_mask(mask)
    assert found.shape == (2, 3, 1)
    assert found.sum() == 5
    assert not found[0, 0]
    assert sample.reduced_mask(None) is None
