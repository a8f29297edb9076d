"""The plainest caller of a trainer: for tests, benchmarks, and anyone without nerfstudio."""

from collections.abc import Callable

from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.gaussians.param_swap import Optimizers
from abcd_ns.engine.render.loss import squared_errors
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
    batch = coordinator.next_batch()
    read = (sample.reduced(photo(sample.view.index, sample.source)) for sample in batch.samples)
    photos = [pixels.to(coordinator.device, non_blocking=True) for pixels in read]
    rendered = coordinator.render(batch)
    step_by(coordinator.loss(batch, rendered.pictures, photos), coordinator.optimizers)
    coordinator.after_step(rendered, squared_errors(rendered.pictures, photos))


def step_by(loss: Float[Tensor, ""], optimizers: Optimizers) -> None:
    """Take a loss' gradient, if it has one, and step every optimizer."""
    for optimizer in optimizers.values():
        optimizer.zero_grad(set_to_none=True)
    if loss.requires_grad:
        loss.backward()
    for optimizer in optimizers.values():
        optimizer.step()
