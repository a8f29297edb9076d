"""What a step is given, layers included, the active block that it changes, and whole pictures between steps."""
