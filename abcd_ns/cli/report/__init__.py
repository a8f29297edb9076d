"""`abcd report`: `run_folder` reads a run without trust, `command` puts what the others make into HTML."""
