"""Moments at which a kill could do most harm, by name. Nothing happens there, unless a test ends the run."""

FILE_WRITTEN = "file written"  # complete under its temporary name, and not synced
FILE_SYNCED = "file synced"  # and not yet in place of the old one
FILE_IN_PLACE = "file in place"  # its folder is not synced
SHARDS_IN_PLACE = "shards in place"  # of a commit; the manifest is the old generation's
GENERATION_PUBLISHED = "generation published"  # shards of the old one are still there
SHARD_DELETED = "shard deleted"  # one of those that nothing names any more
SHARDS_LINKED = "shards linked"  # of a clone; it has no manifest
VISIT_TRAINED = "visit trained"  # all steps are done; nothing is committed
CHECKPOINT_PINNED = "checkpoint pinned"  # there is no step-*.ckpt for it
CHECKPOINT_WRITTEN = "checkpoint written"  # complete under a temporary name
CHECKPOINT_IN_PLACE = "checkpoint in place"  # older checkpoints and their pins are there, too


def reached(point: str) -> None:
    """Called at every point with its name."""
