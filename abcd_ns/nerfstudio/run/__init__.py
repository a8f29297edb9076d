"""A run as its user meets it: progress, log, folder and how it stops."""
