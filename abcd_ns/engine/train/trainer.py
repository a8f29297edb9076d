"""What the caller of a training deals with, however blocks are trained.

The caller owns the loop: it asks for a batch, renders it, takes the gradient of its loss, steps the
optimizers, and reports back.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor

from abcd_ns.engine.train.run import TrainingRun
from abcd_ns.engine.train.run_state import RunState, Stopwatch
from abcd_ns.engine.train.step.batch import Batch, Pictures, Rendered
from abcd_ns.engine.types import View


class Trainer(ABC):
    """Trains a scene step by step, and tells its listeners what happens."""

    trains_elsewhere: bool = False
    """Whether steps are taken by others now: then `await_step` stands for a whole step."""
    layer_limit: int = 0
    """Bytes that layers may take, on the device and in RAM."""
    layer_bytes: int = 0
    """Bytes that layers take."""

    def __init__(self, run: TrainingRun) -> None:
        self.run = run
        self.config, self.scene = run.config, run.scene
        self.params, self.optimizers, self.device = run.params, run.optimizers, run.device
        self.announce, self.health = run.announce, run.health

    @property
    @abstractmethod
    def batch(self) -> int:
        """Views in a step, as things stand."""

    @abstractmethod
    def next_batch(self) -> Batch:
        """Set the learning rates, and say what to train on next."""

    @abstractmethod
    def render(self, batch: Batch) -> Rendered:
        """The pictures of a batch, or of a part of it, with gradients."""

    @abstractmethod
    def loss(self, batch: Batch, pictures: Pictures, photos: Pictures) -> Float[Tensor, ""]:
        """What a batch adds to the loss of a step."""

    def gathered(self, rendered: Rendered) -> Rendered:
        """Call with what a part drew, after its backward, before the next is drawn. What its Gaussians were
        found to do is added up; gives what `after_step` still wants."""
        return rendered

    @abstractmethod
    def after_step(self, rendered: Rendered, errors: Sequence[Tensor] = ()) -> None:
        """Call after the optimizers stepped, with what all parts of the step drew (`Rendered.kept` suffices,
        `gathered` of all but the last) and each picture's mean squared error."""

    def complete(self) -> None:  # noqa: B027 - most have nothing left to do
        """Call when the run is finished: does what comes after the last step, if it was not done."""

    def await_step(self) -> None:
        """Return when one more step of the run has been taken elsewhere, or the run is finished."""
        raise RuntimeError("steps are taken here: call next_batch")

    def await_visits(self) -> bool:
        """Wait for what is trained elsewhere, without beginning more; whether there was any."""
        return False

    def dismiss(self) -> None:  # noqa: B027 - most have nobody
        """End workers that train elsewhere. Harmless when done twice."""

    def pause(self) -> None:
        """From now on no time counts, until the next step; but where others go on training it does."""
        self.stopwatch.pause()

    def resume(self) -> None:
        """Time counts again; steps do this by themselves."""
        self.stopwatch.start()

    @property
    def state(self) -> RunState:
        """All that is known of the run besides the blocks."""
        return self.run.state

    @property
    def views(self) -> dict[int, View]:
        """The training views by index, as they stand by now."""
        return self.run.views

    @property
    def stopwatch(self) -> Stopwatch:
        """Seconds of training."""
        return self.run.stopwatch

    @property
    def progress(self) -> float:
        """Share of the run that is done, 0..1."""
        return self.run.progress

    @property
    def finished(self) -> bool:
        """Whether the budget is used up."""
        return self.progress >= 1.0

    def count(self) -> int:
        """Gaussians in the whole scene, what is active included."""
        return self.run.count()

    @abstractmethod
    def persist(self, within: float) -> None:
        """Persist what is active, and the run's state; on disk within so many seconds."""

    def save(self, pin: str | None = None) -> None:
        """Commit everything, what is active included; with a `pin`, keep it under that name."""
        self.persist(0.0)
        if pin is not None:
            self.scene.store.pin(pin)

    @abstractmethod
    def restore(self) -> None:
        """Go on from the store's newest generation: where `save` was called, or something was persisted."""

    def close(self) -> None:
        """Write what waits to be written, and let go of the store, as `StoredScene.close`."""
        self.scene.close()
