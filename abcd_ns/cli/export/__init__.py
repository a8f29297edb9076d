"""`abcd export`: a trained scene as files for other programs, whole or in parts.

`formats` knows the suffixes; `ply` and `glb` are written block by block, `packed` all at once.
"""
