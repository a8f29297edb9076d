"""Moments at which a kill could do most harm, by name. Nothing happens there, unless a test ends the run."""

from collections.abc import Callable

FILE_WRITTEN = "file written"
"""A new file is complete under its temporary name, and not synced."""
FILE_SYNCED = "file synced"
"""It is synced, and not yet in place of the old one."""
FILE_IN_PLACE = "file in place"
"""It is in place; its folder is not synced."""
SHARDS_IN_PLACE = "shards in place"
"""A commit's shards are safe; the manifest is the old generation's."""
GENERATION_PUBLISHED = "generation published"
"""The manifest names the new generation; shards of the old one are still there."""
SHARD_DELETED = "shard deleted"
"""One of the shards that nothing names any more is gone."""
SHARDS_LINKED = "shards linked"
"""A clone has all its shards and no manifest."""
VISIT_TRAINED = "visit trained"
"""All steps of a visit are done; nothing of it is committed."""
CHECKPOINT_PINNED = "checkpoint pinned"
"""A checkpoint's generation is pinned; there is no step-*.ckpt for it."""
CHECKPOINT_WRITTEN = "checkpoint written"
"""Its file is complete under a temporary name."""
CHECKPOINT_IN_PLACE = "checkpoint in place"
"""It is there; older checkpoints and their pins are, too."""


def _go_on(point: str) -> None:
    """What a run does at every point."""
    del point


reached: Callable[[str], None] = _go_on
"""Called at every point with its name. Tests put another function here."""
