"""`abcd report`: `run_folder` reads a run without trust, `page` puts what the others make into HTML."""

GENERATOR = "abcd report"  # begins the page's generator, by which a page of ours is known
