"""The viewer: what keeps strangers out of it, and the panel that shows blocks, progress and memory."""
