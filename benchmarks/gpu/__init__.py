"""What a CUDA device makes of all this; see __main__.py."""
