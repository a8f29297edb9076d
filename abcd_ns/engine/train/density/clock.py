"""The clock that density control goes by: the run's, and the active block's own."""

from dataclasses import dataclass


@dataclass(frozen=True)
class DensityClock:
    """Where the run and the active block stand; all that decides whether to refine."""

    progress: float
    """Share of the run that is done: 0..1."""
    steps: int
    """Views that were drawn to train the block so far, this step's included."""
    taken: int
    """This step's."""
    views: int
    """Views that the block is trained on."""
    room: int | None
    """Gaussians that may still be added to the scene; None for no limit."""
    seed: int
    """Of the random numbers drawn in this step."""
    refined: int = 0
    """`steps` when the block was last refined."""
    first: bool = False
    """Whether a block among others is in its first visit: all it has is what the warm-up had room for."""
    spent: float = 0.0
    """Share of the visit that is done; 0 in the warm-up and where there are no other blocks."""
    visit: int | None = None
    """Views that the visit draws; None for no end. A block is refined once a visit even if thousands of views
    show it."""

    @property
    def pace(self) -> float:
        """Views that the whole run would draw, if it went on as it has so far."""
        return self.steps / max(self.progress, 1e-9)

    def reached(self, every: int) -> bool:
        """Whether `steps` has come to a multiple of `every` in this step."""
        return self.steps // every > (self.steps - self.taken) // every
