"""One step: what it draws, and the live block that it changes."""
