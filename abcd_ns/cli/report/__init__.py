"""`abcd report`: `run_folder` reads a run without trust, `page` puts what the others make into HTML."""
