"""A training run, whatever starts it: its options, what fits on the device, its store, what trains it."""

STATE = "abcd"
"""The folder of a run that holds all that is ours; `ns-train` has `nerfstudio_models` beside it."""
STORE, SETTINGS_FILE = "store", "settings.json"  # the stored blocks, and a run's options, in STATE
