"""What one step of training is given, and what it draws."""

import random
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.config import TrainingConfig
from abcd_ns.engine.painter import Parts
from abcd_ns.engine.rasterizer import ZWindow
from abcd_ns.engine.rasterizer.projection import Splats
from abcd_ns.engine.types import Crop, View


@dataclass(frozen=True)
class Sample:
    """One view that a step trains on."""

    view: View
    crop: Crop
    layers: Parts | None
    near: Splats | None
    window: ZWindow | None
    background: Float[Tensor, "3"]


@dataclass(frozen=True)
class Batch:
    """What one step trains on."""

    step: int
    samples: tuple[Sample, ...]


@dataclass(frozen=True)
class Rendered:
    """The active block within its surroundings, as a batch shows it."""

    pictures: tuple[Float[Tensor, "_h _w 3"], ...]
    """Of each sample's crop, background included, 0..1."""
    transmittances: tuple[Float[Tensor, "_h _w"], ...]
    """Of the active block and what was sorted in with it."""
    infos: tuple[dict[str, Any], ...]


def background(config: TrainingConfig, step: int, place: int) -> Float[Tensor, "3"]:
    """What lies behind the scene in the sample at `place` of a step's batch; depends on nothing else."""
    if config.background == "random":
        drawn = random.Random(f"background {config.seed} {step} {place}").getrandbits(62)
        return torch.rand(3, generator=torch.Generator().manual_seed(drawn))
    return torch.full((3,), float(config.background == "white"))
