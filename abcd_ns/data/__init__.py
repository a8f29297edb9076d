"""Captures: cameras, points and photos of a COLMAP model or transforms.json, checked and put in one frame.

`prepare` reads a whole capture, `scene` is what comes of it, `photos` decodes, the others know file formats.
"""
