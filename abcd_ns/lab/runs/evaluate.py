"""Held-out views, drawn and scored without leaving a trace in the training that goes on around it."""

from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from statistics import fmean

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from nerfstudio.pipelines.base_pipeline import VanillaPipeline
from torch import Tensor

from abcd_ns.engine.render.loss import decibels, psnr
from abcd_ns.engine.types import Layer
from abcd_ns.lab.results.results import ViewScore
from abcd_ns.nerfstudio.metrics import counted, image_metrics
from abcd_ns.nerfstudio.model import AbcdModel

Picture = Float[Tensor, "h w 3"]


@dataclass(frozen=True)
class Drawn:
    """A view that no method is trained on, and what a trained model makes of it; pictures are 0..1."""

    row: int
    name: str
    photo: Picture  # on the model's background where the file has an alpha channel
    mask: Bool[Tensor, "h w 1"] | None  # where it counts; None for everywhere
    merged: Picture  # all Gaussians at once, as any viewer draws them
    composited: Picture | None
    """Block by block. For a model without blocks both are the same picture; None where it was not drawn."""

    @property
    def psnr(self) -> float:
        """Of the merged picture, dB."""
        return float(psnr(counted(self.merged, self.mask), counted(self.photo, self.mask)))

    @property
    def score(self) -> ViewScore:
        """How close both pictures come to the photo."""
        composited, merged = (
            image_metrics(picture, self.photo, mask=self.mask) for picture in (self.composited, self.merged)
        )
        scores = (composited["psnr"], composited["ssim"], composited.get("lpips"))
        return ViewScore(self.row, self.name, *scores, merged["psnr"], merged["ssim"])

    @property
    def squared_gap(self) -> float:
        """Mean squared difference of the merged and the composited picture."""
        return float((self.merged - self.composited).double().square().mean())


def draw_held_out(
    pipeline: VanillaPipeline, rows: Collection[int] | None = None, composited: bool = True
) -> Iterator[Drawn]:
    """Every held-out view, or those at `rows`, in order; photos are read one at a time where possible. The
    blocks are drawn one by one, too, if `composited`."""
    model, names = pipeline.model, pipeline.datamanager.eval_dataset.image_filenames
    background = model.background_color.to(model.device)
    with undisturbed(pipeline):
        for row, (camera, batch) in enumerate(pipeline.datamanager.fixed_indices_eval_dataloader):
            if rows is not None and row not in rows:
                continue
            photo = model.composite_with_background(model.get_gt_img(batch["image"]), background)
            if isinstance(model, AbcdModel):
                view = model.view(camera)
                merged = _on_background(model.draw_merged(view).layer, model)
                blocks = _on_background(model.draw_composited(view), model) if composited else None
            else:
                merged = blocks = model.get_outputs_for_camera(camera)["rgb"]
            yield Drawn(row, names[row].name, photo, batch.get("mask"), merged, blocks)


def ordering_gap(squared_gaps: Sequence[float], blocks: int) -> tuple[float | None, str | None]:
    """The ordering gap, dB, by the `squared_gap` of each held-out view; or None and why there is none."""
    if blocks == 1:
        return None, "one block: merged and composited are the same picture"
    if any(squared_gaps):
        return decibels(fmean(squared_gaps)), None
    return None, "merged and composited pictures are equal to the last bit"


def mean(values: Sequence[float | None]) -> float | None:
    """The mean, or None if any value is missing."""
    return None if not values or None in values else fmean(values)


def to_bytes(picture: Picture) -> UInt8[np.ndarray, "h w 3"]:
    """A picture as files hold it."""
    return (picture.clamp(0, 1) * 255).round().byte().cpu().numpy()


@contextmanager
def undisturbed(pipeline: VanillaPipeline) -> Iterator[None]:
    """No gradients; training mode and torch's random numbers are afterwards as they were."""
    model, was_training = pipeline.model, pipeline.training
    devices = [model.device] if model.device.type == "cuda" else []
    pipeline.eval()
    try:
        with torch.no_grad(), torch.random.fork_rng(devices):
            yield
    finally:
        pipeline.train(was_training)


def _on_background(layer: Layer, model: AbcdModel) -> Picture:
    background = model.background_color.to(layer.color.device)
    return (layer.color + layer.transmittance[..., None] * background).clamp(0, 1)
