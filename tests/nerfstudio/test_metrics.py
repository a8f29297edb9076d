"""How close a picture is to its photo, with its light or without."""

import pytest
import torch

from abcd_ns.nerfstudio.metrics import image_metrics


def test_a_corrected_psnr_leaves_the_light_of_the_photo_out():
    picture = 0.2 + 0.4 * torch.rand(20, 30, 3, generator=torch.Generator().manual_seed(0))
    noise = 0.01 * torch.randn(20, 30, 3, generator=torch.Generator().manual_seed(1))
    photo = 1.3 * picture + 0.05 + noise
    assert "cc_psnr" not in image_metrics(picture, photo)
    found = image_metrics(picture, photo, corrected=True)
    assert found["psnr"] < 17
    assert found["cc_psnr"] == pytest.approx(40, abs=0.5)  # the noise alone


def test_hidden_pixels_are_not_scored():
    photo = torch.rand(20, 30, 3, generator=torch.Generator().manual_seed(0))
    mask = torch.ones(20, 30, 1).bool()
    mask[:, 20:] = False
    picture = torch.where(mask, photo + 0.1, 0.0)
    found = image_metrics(picture, photo, mask=mask)
    assert found["psnr"] == pytest.approx(20, abs=1e-3)
    assert found == image_metrics(torch.where(mask, picture, 1.0), photo, mask=mask)


@pytest.mark.parametrize("size", [(10, 30), (30, 7), (2, 2), (1, 1)])
def test_pictures_smaller_than_the_window_of_ssim_have_the_scores_of_others(size):
    """Else one of them among held-out photos is a KeyError in nerfstudio's mean."""
    photo = torch.rand(*size, 3, generator=torch.Generator().manual_seed(0))
    found = image_metrics(photo, photo)
    assert found.keys() == image_metrics(torch.zeros(20, 30, 3), torch.zeros(20, 30, 3)).keys()
    assert found["ssim"] == pytest.approx(1)
    assert image_metrics(1 - photo, photo)["ssim"] < 0.95


def test_black_pictures_are_scored_too():
    black = torch.zeros(20, 30, 3)
    assert image_metrics(black, black + 0.5, corrected=True)["cc_psnr"] > 0
