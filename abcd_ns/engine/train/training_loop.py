"""The plainest caller of a trainer: for tests, benchmarks, and anyone without nerfstudio."""

from collections.abc import Callable, Iterable

from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.gaussians.param_swap import Optimizers
from abcd_ns.engine.render.loss import squared_errors
from abcd_ns.engine.train.step.batch import Batch, Rendered
from abcd_ns.engine.train.trainer import Trainer
from abcd_ns.engine.types import Crop

PhotoReader = Callable[[int, Crop], Float[Tensor, "h w 3"]]
"""Gives the pixels of a crop of a view's photo, 0..1, by the view's index."""


def train(coordinator: Trainer, photo: PhotoReader, steps: int | None = None) -> None:
    """Take `steps` optimisation steps, or go on until the coordinator's budget is used up."""
    taken = 0
    while not coordinator.finished and (steps is None or taken < steps):
        train_step(coordinator, photo)
        taken += 1
    if coordinator.finished:
        coordinator.complete()


def train_step(coordinator: Trainer, photo: PhotoReader) -> None:
    """Render a batch, take its loss' gradient, step every optimizer, report back."""
    if coordinator.trains_elsewhere:
        coordinator.await_step()
        return
    drawn, errors = [], []

    def loss_of(part: Batch) -> Tensor:
        read = (sample.reduced(photo(sample.view.index, sample.source)) for sample in part.samples)
        photos = [pixels.to(coordinator.device, non_blocking=True) for pixels in read]
        rendered = coordinator.render(part)
        drawn.append(rendered.kept)
        errors.extend(squared_errors(rendered.pictures, photos))
        return coordinator.loss(part, rendered.pictures, photos)

    step_by(map(loss_of, coordinator.next_batch().parts()), coordinator.optimizers)
    coordinator.after_step(Rendered.joined(drawn), errors)


def step_by(losses: Iterable[Float[Tensor, ""]], optimizers: Optimizers) -> None:
    """Take the gradients of a step's losses, one after the other, and step every optimizer."""
    for optimizer in optimizers.values():
        optimizer.zero_grad(set_to_none=True)
    for loss in losses:
        if loss.requires_grad:
            loss.backward()
        del loss  # before more is drawn
    for optimizer in optimizers.values():
        optimizer.step()
