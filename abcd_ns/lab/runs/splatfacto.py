"""Splatfacto as a peer: on the photos and cameras that ABCD reads, without what its own scores alone need."""

from unittest import mock

import torch
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanager
from nerfstudio.models.splatfacto import SplatfactoModel
from torchmetrics.image import lpip

from abcd_ns.data.dataset import AbcdDataset


class Splatfacto(SplatfactoModel):
    """Splatfacto, of which only pictures are asked: they are scored as all others are."""

    def populate_modules(self) -> None:
        """As splatfacto's, without LPIPS, whose weights, 233 MiB, nerfstudio would fetch from the network."""
        with mock.patch.object(lpip, "LearnedPerceptualImagePatchSimilarity", torch.nn.Identity):
            super().populate_modules()


class SplatfactoData(FullImageDatamanager[AbcdDataset]):
    """Splatfacto's own datamanager on the very photos and cameras that ABCD reads."""
