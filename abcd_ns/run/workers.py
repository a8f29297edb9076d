"""How many workers a run has."""

import torch

from abcd_ns.cluster.forked_workers import can_fork
from abcd_ns.engine.train.config import TrainingConfig
from abcd_ns.engine.train.recipe import Recipe
from abcd_ns.errors import UserError
from abcd_ns.machine import threads_wanted
from abcd_ns.run.fit import Fit
from abcd_ns.units import bytes_in_words

BLOCKS_EACH = 2
"""Blocks for each worker at least, where their number is not given: one in training, one that rests."""


def blocks_to_begin_with(fit: Fit, workers: int) -> int:
    """As few as fit the device, but enough for every worker.

    Args:
        workers: 0 for none, also where one process trains.

    Raises:
        UserError: they need several blocks, and there is no room for the layers around one.
    """
    if workers and not fit.limit:
        raise UserError(
            f"{bytes_in_words(fit.budget)} of the device have no room for a block among others, which "
            "workers need: train without workers, or on smaller photos."
        )
    return max(fit.blocks, BLOCKS_EACH * workers)


def works_at_once(recipe: Recipe) -> bool:
    """Whether a method can train several blocks at once."""
    return not recipe.exact and recipe.overlap == 0


def number_of_workers(asked: int, blocks: int, training: TrainingConfig, device: torch.device | str) -> int:
    """`RunOptions.workers`, its 0 resolved.

    Args:
        blocks: of the scene.
    """
    if asked:
        return asked
    # Workers learn nothing of light and poses: two of them may show one photo.
    learns = training.light != "none" or training.poses != "off"
    if learns or not works_at_once(training.recipe) or not can_fork(torch.device(device)):
        return 1
    return max(min(threads_wanted(), blocks // BLOCKS_EACH), 1)
