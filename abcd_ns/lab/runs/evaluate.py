"""Held-out views, drawn and scored without leaving a trace in the training that goes on around it."""

import math
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.models.splatfacto import SplatfactoModel
from nerfstudio.pipelines.base_pipeline import VanillaPipeline
from torch import Tensor

from abcd_ns.engine.render.loss import psnr
from abcd_ns.engine.types import Layer
from abcd_ns.lab.results.run import ViewScore
from abcd_ns.nerfstudio.metrics import counted, image_metrics
from abcd_ns.nerfstudio.model import AbcdModel

Picture = Float[Tensor, "h w 3"]


@dataclass(frozen=True)
class HeldOutView:
    """A view that no method is trained on."""

    row: int
    name: str
    camera: Cameras
    photo: Picture
    """On the model's background where the file has an alpha channel."""
    mask: Bool[Tensor, "h w 1"] | None = None
    """Where it counts; None for everywhere."""


@dataclass(frozen=True)
class Drawn:
    """A held-out view and what a trained model makes of it, 0..1."""

    view: HeldOutView
    merged: Picture
    composited: Picture


def held_out_views(pipeline: VanillaPipeline) -> Iterator[HeldOutView]:
    """All held-out views in order, one photo in memory at a time where the datamanager allows."""
    model, dataset = pipeline.model, pipeline.datamanager.eval_dataset
    background = model.background_color.to(model.device)
    for row, (camera, batch) in enumerate(pipeline.datamanager.fixed_indices_eval_dataloader):
        photo = model.composite_with_background(model.get_gt_img(batch["image"]), background)
        yield HeldOutView(row, dataset.image_filenames[row].name, camera, photo, batch.get("mask"))


def draw_merged(model: SplatfactoModel, camera: Cameras) -> Picture:
    """All Gaussians at once, as any viewer draws them."""
    if isinstance(model, AbcdModel):
        return _on_background(model.draw_merged(model.view(camera)).layer, model)
    return model.get_outputs_for_camera(camera)["rgb"]


def mean_psnr(pipeline: VanillaPipeline) -> float:
    """Mean over the held-out views of the merged pictures' PSNR, dB."""
    with undisturbed(pipeline):
        pairs = ((draw_merged(pipeline.model, v.camera), v.photo, v.mask) for v in held_out_views(pipeline))
        scores = [float(psnr(counted(drawn, mask), counted(photo, mask))) for drawn, photo, mask in pairs]
    return sum(scores) / len(scores)


def draw_held_out(pipeline: VanillaPipeline, rows: Collection[int] | None = None) -> Iterator[Drawn]:
    """Every held-out view, or those at `rows`, in the order of the rows: all Gaussians at once, and block by
    block. For a model without blocks both are the same picture."""
    model = pipeline.model
    with undisturbed(pipeline):
        for view in held_out_views(pipeline):
            if rows is None or view.row in rows:
                merged = composited = draw_merged(model, view.camera)
                if isinstance(model, AbcdModel):
                    composited = _on_background(model.draw_composited(model.view(view.camera)), model)
                yield Drawn(view, merged, composited)


def score(drawn: Drawn) -> ViewScore:
    """How close both pictures come to the photo."""
    view = drawn.view
    composited, merged = (
        image_metrics(picture, view.photo, mask=view.mask) for picture in (drawn.composited, drawn.merged)
    )
    scores = (composited["psnr"], composited.get("ssim"), composited.get("lpips"))
    return ViewScore(view.row, view.name, *scores, merged["psnr"], merged.get("ssim"))


def squared_gap(drawn: Drawn) -> float:
    """Mean squared difference of the merged and the composited picture."""
    return float((drawn.merged - drawn.composited).double().square().mean())


def ordering_gap(squared_gaps: Sequence[float], blocks: int) -> tuple[float | None, str | None]:
    """The ordering gap, dB, or None and why there is none.

    Args:
        squared_gaps: by held-out view, from `squared_gap`.
    """
    if blocks == 1:
        return None, "one block: merged and composited are the same picture"
    mean = sum(squared_gaps) / len(squared_gaps)
    if mean == 0:
        return None, "merged and composited pictures are equal to the last bit"
    return -10 * math.log10(mean), None


def mean(values: Sequence[float | None]) -> float | None:
    """The mean, or None if any value is missing."""
    if not values or any(value is None for value in values):
        return None
    return sum(values) / len(values)


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
