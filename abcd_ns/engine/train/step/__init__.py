"""What a step is given, the active block that it changes, and whole pictures between steps."""
