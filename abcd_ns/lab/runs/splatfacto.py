"""Splatfacto as a peer: on the photos and cameras that ABCD reads, without what its own scores alone need.

Where there is no CUDA, nerfstudio's own model, strategy, optimizers and schedules run on a CPU: this
package's `rasterization` stands in for gsplat's.
"""

import copy
from collections.abc import Iterator
from contextlib import contextmanager
from unittest import mock

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanager
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.models import splatfacto
from nerfstudio.models.splatfacto import SplatfactoModel
from torchmetrics.image import lpip

from abcd_ns.data.dataset import AbcdDataset
from abcd_ns.engine.render.rasterization import rasterization

SHIPPED_STEPS = 30_000
COUNTED_IN_STEPS = (
    "warmup_length",
    "refine_every",
    "resolution_schedule",
    "sh_degree_interval",
    "stop_screen_size_at",
    "stop_split_at",
)
"""Of its model's options."""


class Splatfacto(SplatfactoModel):
    """Splatfacto, of which only pictures are asked: they are scored as all others are."""

    def populate_modules(self) -> None:
        """As splatfacto's, without LPIPS, whose weights, 233 MiB, nerfstudio would fetch from the network."""
        with (
            mock.patch.object(lpip, "LearnedPerceptualImagePatchSimilarity", torch.nn.Identity),
            _as_on_cuda(),
        ):
            super().populate_modules()

    def get_outputs(self, camera: Cameras) -> dict[str, torch.Tensor | list]:
        """As splatfacto's, on any device."""
        with _as_on_cuda():
            return super().get_outputs(camera)


class SplatfactoData(FullImageDatamanager[AbcdDataset]):
    """Splatfacto's own datamanager on the very photos and cameras that ABCD reads."""


@contextmanager
def _as_on_cuda() -> Iterator[None]:
    """Around calls that ask for CUDA by name."""
    if torch.cuda.is_available():
        yield
        return
    uncompiled = splatfacto.get_viewmat._torchdynamo_orig_callable
    with (
        mock.patch.object(torch.Tensor, "cuda", lambda tensor: tensor),
        mock.patch.object(splatfacto, "rasterization", rasterization),
        mock.patch.object(splatfacto, "get_viewmat", uncompiled),
    ):
        yield


def scaled(config: TrainerConfig, steps: int) -> TrainerConfig:
    """Splatfacto with all its step counts in proportion to `steps`, as shipped for SHIPPED_STEPS."""
    config, share = copy.deepcopy(config), steps / SHIPPED_STEPS
    model = config.pipeline.model
    for name in COUNTED_IN_STEPS:
        setattr(model, name, max(round(share * getattr(model, name)), 1))
    for group in config.optimizers.values():
        if (schedule := group["scheduler"]) is not None:
            schedule.max_steps = steps
            schedule.warmup_steps = round(share * schedule.warmup_steps)
    return config
