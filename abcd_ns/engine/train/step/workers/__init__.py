"""Processes that share the views of a step on a CPU with many cores."""
