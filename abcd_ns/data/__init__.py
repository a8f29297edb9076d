"""Captures: cameras, points and photos of a COLMAP model or transforms.json, checked and put in one frame."""
