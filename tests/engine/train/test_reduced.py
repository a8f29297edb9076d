"""Pictures that grow with the run: cameras, photos and masks of any size agree, and so do layers."""

import pytest
import torch

from abcd_ns.engine.train import schedule
from abcd_ns.engine.train.schedule import reduction_at
from abcd_ns.engine.train.step.batch import Sample
from abcd_ns.engine.train.training_loop import train, train_step
from abcd_ns.engine.types import Crop, View
from tests.reference.rasterizer_scenes import project
from tests.reference.scenes import Photos, make_coordinator, random_gaussians, ring_of_views, whole_scene


@pytest.fixture
def small_pictures(monkeypatch):
    """Pictures of 48 x 36 px are reduced, too."""
    monkeypatch.setattr(schedule, "LEAST_SIDE", 9)


def sample_of(view: View, crop: Crop) -> Sample:
    return Sample(view, crop, None, None, torch.zeros(3))


def test_pictures_grow_by_share_and_never_become_too_small():
    shares = [0.0, 0.19, 0.2, 0.39, 0.4, 1.0]
    assert [reduction_at(share, 0.4, 640) for share in shares] == [4, 4, 2, 2, 1, 1]
    assert [reduction_at(share, 0.4, 213) for share in shares] == [2, 2, 2, 2, 1, 1]
    assert {reduction_at(share, 0.4, 120) for share in shares} == {1}
    assert {reduction_at(share, 0.0, 640) for share in shares} == {1}


@pytest.mark.parametrize("by", [1, 2, 4])
def test_a_reduced_camera_sees_the_same_in_larger_pixels(by):
    (view,), gaussians = (
        ring_of_views(1, width=50, dtype=torch.float64),
        random_gaussians(20).to(torch.float64),
    )
    small = view.reduced(by)
    assert (small.width, small.height, small.reduction) == (50 // by, 36 // by, by)
    found, full = project(gaussians, small), project(gaussians, view)
    torch.testing.assert_close(found.means2d * by, full.means2d)
    torch.testing.assert_close(found.depths, full.depths)


def test_a_reduced_photo_is_the_mean_of_its_squares():
    (view,) = ring_of_views(1)
    sample = sample_of(view.reduced(4), Crop(2, 1, 5, 6))
    assert sample.source == Crop(8, 4, 20, 24)
    photo = torch.rand(24, 20, 3)
    expected = torch.stack(
        [
            torch.stack([photo[4 * y : 4 * y + 4, 4 * x : 4 * x + 4].mean(dim=(0, 1)) for x in range(5)])
            for y in range(6)
        ]
    )
    torch.testing.assert_close(sample.reduced(photo), expected)


def test_alpha_and_masks_are_reduced_with_what_they_stand_for():
    (view,) = ring_of_views(1)
    sample = sample_of(view.reduced(2), Crop(0, 0, 3, 2))
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


def test_samples_grow_with_the_run(tmp_path, small_pictures):  # noqa: ARG001 - a fixture
    views = ring_of_views(4)
    photos = Photos(random_gaussians(40, seed=1, size=0.2), views)
    start = random_gaussians(60, seed=2)
    coordinator = make_coordinator(tmp_path, start, views, blocks=1, steps=60, coarse=0.6)
    seen = []
    while not coordinator.finished:
        train_step(coordinator, photos)
        seen.append(coordinator.run.reduction)
    assert {1, 2, 4} == set(seen)
    assert seen == sorted(seen, reverse=True)


def test_a_run_goes_on_with_the_pictures_it_stopped_at(tmp_path, small_pictures):  # noqa: ARG001
    views = ring_of_views(4)
    photos = Photos(random_gaussians(40, seed=1, size=0.2), views)
    results = []
    for stop in (None, 17):
        folder = tmp_path / str(stop)
        folder.mkdir()
        options = {"blocks": 1, "steps": 40, "coarse": 0.7}
        coordinator = make_coordinator(folder, random_gaussians(60, seed=2), views, **options)
        if stop:
            train(coordinator, photos, stop)
            coordinator.rest(0.0)
            coordinator.close()
            coordinator = make_coordinator(
                folder, random_gaussians(60, seed=2), views, resume=True, **options
            )
        train(coordinator, photos)
        results.append(whole_scene(coordinator))
    assert all(torch.equal(value, getattr(results[1], name)) for name, value in results[0].items())
