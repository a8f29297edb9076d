"""A run as its user meets it: progress, settings, log, how it stops and how it goes on."""

STATE = "abcd"
"""The folder of a run, beside `nerfstudio_models`, that holds the one that follows."""
STORE = "store"
"""The blocks at rest."""
