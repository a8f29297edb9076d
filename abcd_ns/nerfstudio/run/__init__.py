"""A run as its user meets it: progress, settings, log, how it stops and how it resumes."""
