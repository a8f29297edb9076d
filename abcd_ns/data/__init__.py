"""Captures: cameras, points and photos of a COLMAP model or transforms.json, checked and put in one frame.

`prepare` reads a whole capture, `scene` is what comes of it, `photos` decodes, the others know file formats.
Whatever reads or checks something raises InputError, which names the file or value and what to do; what looks
at many files lists all that are bad.
"""

OPTION = "--pipeline.datamanager.dataparser."  # begins the options of the reader of data
DOWNSCALE = f"{OPTION}downscale-factor"  # the option by which photos are reduced
