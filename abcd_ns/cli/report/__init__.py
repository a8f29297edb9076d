"""`abcd report`: one training run as one HTML page.

`run_folder` reads a run and trusts none of it, `page` fills a template with what the others make.
"""
