"""The viewer: a guard that keeps strangers out, and the panel of blocks, progress and memory."""
