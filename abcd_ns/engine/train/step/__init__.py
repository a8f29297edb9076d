"""What a step is given, layers included, the active block that it changes, whole pictures between steps."""
