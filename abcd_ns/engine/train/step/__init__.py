"""One step: what it draws, alone or with helpers, and the live block that it changes."""
