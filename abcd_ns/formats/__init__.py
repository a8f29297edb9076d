"""Files that hold Gaussians, as other programs read them.

`scene_file` knows the suffixes; `ply` and `glb` are written part by part, `packed` all at once; `sizes` tells
how large they would be.
"""
