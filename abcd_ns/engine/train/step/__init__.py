"""What a step is given, the live block that it changes, and whole pictures between steps."""
