"""The plainest caller of a trainer: for tests, benchmarks, and anyone without nerfstudio."""

from collections.abc import Callable, Sequence

from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.gaussians.param_swap import Optimizers
from abcd_ns.engine.render.loss import squared_errors
from abcd_ns.engine.train.step.batch import Batch, Rendered
from abcd_ns.engine.train.trainer import Trainer
from abcd_ns.engine.train.visit_training import VisitTraining
from abcd_ns.engine.types import Crop

Judgement = tuple[Float[Tensor, ""], Sequence[Float[Tensor, ""]]]
"""A part's loss, and the mean squared error of each of its pictures."""
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

    def assess(part: Batch, rendered: Rendered) -> Judgement:
        read = (sample.reduced(photo(sample.view.index, sample.source)) for sample in part.samples)
        photos = [pixels.to(coordinator.device, non_blocking=True) for pixels in read]
        errors = squared_errors(rendered.pictures, photos)
        return coordinator.loss(part, rendered.pictures, photos), errors

    take_step(coordinator, coordinator.optimizers, assess)


def take_step(
    training: Trainer | VisitTraining, optimizers: Optimizers, assess: Callable[[Batch, Rendered], Judgement]
) -> None:
    """Draw a step's parts one by one, take gradients of the losses that `assess` finds, step optimizers."""
    batch, drawn, errors = training.next_batch(), [], []
    for optimizer in optimizers.values():
        optimizer.zero_grad(set_to_none=True)
    for part in batch.parts():
        if drawn:
            drawn[-1] = training.gathered(drawn[-1])
        rendered = training.render(part)
        loss, found = assess(part, rendered)
        drawn.append(rendered.kept)
        errors.extend(found)
        if loss.requires_grad:
            loss.backward()
        del rendered, loss  # before more is drawn
    for optimizer in optimizers.values():
        optimizer.step()
    training.after_step(Rendered.joined(drawn), errors)
