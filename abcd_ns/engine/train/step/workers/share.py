"""A share of a step: some of its views, drawn and differentiated apart from the others."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.train.capture.light import Gradients, gradients_of
from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.train.density.control import DensityControl
from abcd_ns.engine.train.health.health_rules import share_of_picture
from abcd_ns.engine.train.step.batch import Rendered, Sample
from abcd_ns.engine.types import Gaussians

Target = tuple[Float[Tensor, "h w 3"], Tensor | None]
"""What a sample's picture should be, 0..1, and where that counts: [h, w, 1], None for everywhere."""


@dataclass(frozen=True)
class Task:
    """What must be known of a step besides the parameters."""

    done: int
    """Steps of the visit before this one."""
    step: int
    """Steps of the run before this one."""
    sh_degree: int


@dataclass(frozen=True)
class Drawn:
    """What is known of a share when it is drawn."""

    losses: tuple[tuple[int, float], ...]
    """(view, its loss) pairs."""
    loss: float
    """The share's part of the step's loss."""
    shown: float
    """The largest part of a picture that the block is."""


@dataclass(frozen=True)
class Contribution:
    """What a share adds to a step."""

    gradients: dict[str, Tensor]
    """By parameter."""
    counts: dict[str, Tensor]
    """What density control adds up for each Gaussian, by name; may be empty."""
    lights: Gradients = ()
    """Gradients of the pictures' transforms."""


@dataclass(frozen=True)
class Share:
    """A share that is drawn, and yet to be differentiated."""

    drawn: Drawn
    differentiate: Callable[[], Contribution]
    """Takes the gradient; once."""


DrawShare = Callable[[Gaussians, Task], Share]
"""Draws one member's views of a step, differentiable in the Gaussians, which are leaves."""


def share_of(
    gaussians: Gaussians,
    samples: Sequence[Sample],
    rendered: Rendered,
    target: Callable[[Sample], Target],
    config: TrainingConfig,
    density: DensityControl,
    *,
    views: int,
) -> Share:
    """The share that these drawings are.

    Args:
        views: in the whole step, by which its loss is divided.
    """
    losses, shown = [], []
    for sample, picture, own in zip(samples, rendered.pictures, rendered.transmittances, strict=True):
        photo, counts = target(sample)
        if counts is not None:
            counts = counts.to(picture.device)
            picture, photo = picture * counts, photo * counts
        losses.append(sample.loss(picture, photo, config))
        shown.append(share_of_picture(sample.layers and sample.layers.front, own))
    loss = torch.stack(losses).sum() / views
    numbers = torch.stack([each.detach() for each in losses]).tolist()
    indices = (sample.view.index for sample in samples)

    def differentiate() -> Contribution:
        if loss.requires_grad:
            loss.backward()
        gradients = {n: torch.zeros_like(v) if v.grad is None else v.grad for n, v in gaussians.items()}
        counts = density.count(gaussians.means, rendered.infos)
        return Contribution(gradients, counts, gradients_of(rendered.lights))

    drawn = Drawn(tuple(zip(indices, numbers, strict=True)), float(loss.detach()), float(max(shown)))
    return Share(drawn, differentiate)
